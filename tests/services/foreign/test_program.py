"""A real program at the other end of the pipes: what it says is taken apart, and its end is told."""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from services.bus.horizon import Stamped
from services.foreign.program import (
    ProgramDiedError,
    ProgramError,
    ProgramOutput,
    StageProgram,
    greeting,
    step,
)
from services.models.own_stack import OwnStage
from services.models.platform import KernelLatency


@contextmanager
def program(script: str) -> Iterator[StageProgram]:
    command = (sys.executable, "-u", "-c", f"import os, sys, time\n{script}")
    own = OwnStage(command=command, folder="/", sha256="0" * 64, latency=KernelLatency(mean_ms=1))
    running = StageProgram(own, 0)
    try:
        yield running
    finally:
        running.kill()


def test_what_is_said_to_it_byte_for_byte() -> None:
    assert greeting("control", 2, b"{}") == b"zenfi 1 control 2 2\n{}"
    seen = [("trajectory", Stamped(3, 40, b"abc")), ("odometry", Stamped(7, 80, b""))]
    assert step(seen, 80) == b"message trajectory 3 40 3\nabcmessage odometry 7 80 0\nstep 80\n"


def test_it_may_publish_any_number_of_messages_with_any_bytes() -> None:
    script = r"""
sys.stdin.buffer.readline()
sys.stdout.buffer.write(b"put cloud 3\n\n\0\nput map 0\nput cloud 1\nxdone\n")
"""
    with program(script) as one:
        one.tell(step([], 1))
        assert one.answer() == [
            ProgramOutput("cloud", b"\n\0\n"),
            ProgramOutput("map", b""),
            ProgramOutput("cloud", b"x"),
        ]


def test_a_large_message_passes_both_ways() -> None:
    script = """
size = int(sys.stdin.buffer.readline().split()[-1])
body = sys.stdin.buffer.read(size)
sys.stdout.buffer.write(b"put map %d\\n" % size + body[::-1] + b"done\\n")
"""
    content = os.urandom(1 << 20)
    with program(script) as one:
        one.tell(step([("map", Stamped(0, 0, content))], 1))
        assert one.answer() == [ProgramOutput("map", content[::-1])]


@pytest.mark.parametrize(
    "said", ["put cloud", "put cloud -1", "put cloud 999999999999", "nonsense", "x" * 999]
)
def test_nonsense_is_refused(said: str) -> None:
    with program(f"print({said!r}); time.sleep(60)") as one, pytest.raises(ProgramError):
        one.answer()


def test_its_death_is_told_as_it_was() -> None:
    with program("os.abort()") as one, pytest.raises(ProgramDiedError) as died:
        one.answer()
    assert died.value.status == -6
    with program("sys.exit(3)") as one, pytest.raises(ProgramDiedError) as died:
        one.await_ready()
    assert died.value.status == 3


def test_one_that_listens_no_more_is_dead() -> None:
    with program("os.close(0); os._exit(5)") as one, pytest.raises(ProgramDiedError):
        one.tell(bytes(1 << 20))


def test_it_dies_with_who_started_it() -> None:
    read, write = os.pipe()
    child = os.fork()
    if not child:
        own = OwnStage(
            command=(sys.executable, "-c", "import time; time.sleep(60)"),
            folder="/",
            sha256="0" * 64,
            latency=KernelLatency(mean_ms=1),
        )
        os.write(write, b"%d" % StageProgram(own, 0).pid)
        os._exit(0)
    os.waitpid(child, 0)
    pid = int(os.read(read, 16))
    os.close(read)
    os.close(write)
    deadline = time.monotonic() + 20
    while Path(f"/proc/{pid}").exists() and "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2]:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_processor_time_is_that_of_the_program() -> None:
    with program("t = time.process_time()\nwhile time.process_time() < t + 0.2: pass\nprint('ready')") as one:
        one.await_ready()
        assert one.cpu_ns > 200_000_000
