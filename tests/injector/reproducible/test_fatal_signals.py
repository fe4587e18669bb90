"""What ends a node: its own doing or another process, and what a killed injector leaves behind does not."""

import ctypes
import mmap
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from injector.reproducible.fatal_signals import HANDLED, ended_by_another, handle_fatal_signals
from injector.tracing.process import tracer_of
from services.system.process_stat import process_stat
from tests.conftest import wait_until
from tests.injector.programs import clock_ns

pytestmark = pytest.mark.usefixtures("may_inject")

STEPPER = """
import sys
from injector.tracing.tracees import TraceeGroup
with TraceeGroup() as tracees:
    tracees.seize([int(sys.argv[1])])
    while True:
        tracees.stop_all()
        for _ in range(50):
            tracees.step(tracees.threads[int(sys.argv[1])])
        tracees.resume_all()
"""


def ended(do: Callable[[], object], meanwhile: Callable[[int], object]) -> tuple[int, bool]:
    """How a process that handles fatal signals ended, and whether that was another's doing."""
    origin, theirs = os.pipe()
    node = os.fork()
    if not node:
        for number in (signal.SIGHUP, signal.SIGTERM):  # a test run may handle them
            signal.signal(number, signal.SIG_DFL)
        handle_fatal_signals(theirs)
        do()
        os._exit(3)
    os.close(theirs)
    meanwhile(node)
    status = os.waitstatus_to_exitcode(os.waitpid(node, 0)[1])
    by_another = ended_by_another(status, origin)
    os.close(origin)
    return status, by_another


def jump_to_nowhere() -> None:
    ctypes.CFUNCTYPE(None)(16)()


def wait_to_be_ended() -> None:
    while True:
        signal.pause()


@pytest.mark.parametrize(
    ("do", "status"),
    [
        (jump_to_nowhere, -signal.SIGSEGV),
        (os.abort, -signal.SIGABRT),
        (lambda: signal.raise_signal(signal.SIGFPE), -signal.SIGFPE),
        (lambda: os.kill(os.getpid(), signal.SIGBUS), -signal.SIGBUS),
        (lambda: os._exit(9), 9),
    ],
)
def test_what_a_node_dies_of_by_itself_is_a_result(do: Callable[[], object], status: int) -> None:
    assert ended(do, lambda _: None) == (status, False)


@pytest.mark.parametrize("number", sorted(HANDLED | {signal.SIGKILL, signal.SIGTERM, signal.SIGHUP}))
def test_whom_another_process_ends_is_told_so(number: signal.Signals) -> None:
    def end(node: int) -> None:
        wait_until(lambda: process_stat(node).state == "S")
        os.kill(node, number)

    assert ended(wait_to_be_ended, end) == (-number, True)


def test_a_node_outlives_injectors_that_are_killed_while_they_step() -> None:
    node = os.fork()
    if not node:
        handle_fatal_signals(os.open(os.devnull, os.O_WRONLY))
        while True:
            sum(range(100))
    try:
        for moment in range(12):
            injector = subprocess.Popen(
                [sys.executable, "-c", STEPPER, str(node)], cwd=Path(__file__).parents[3]
            )
            while not tracer_of(node):
                assert injector.poll() is None
            time.sleep(0.0013 * moment)
            injector.kill()
            injector.wait()
            assert tracer_of(node) == 0
            begin = clock_ns(node)
            while clock_ns(node) < begin + 1_000_000:
                assert os.waitpid(node, os.WNOHANG) == (0, 0)
    finally:
        os.kill(node, signal.SIGKILL)


def test_a_breakpoint_instruction_kills_as_ever() -> None:
    """A fault may lead to one; to survive it would be another outcome."""
    node = os.fork()
    if not node:
        handle_fatal_signals(os.open(os.devnull, os.O_WRONLY))
        page = mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
        page[:2] = b"\xcc\xc3"  # int3; ret
        ctypes.CFUNCTYPE(None)(ctypes.addressof(ctypes.c_char.from_buffer(page)))()
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(node, 0)[1]) == -signal.SIGTRAP
