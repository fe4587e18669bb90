"""Whether a process has something to compute, however busy the machine is."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from deploy.errors import DisturbedFlightError
from deploy.mission.silence import Silence, computes
from services.system.lifeline import die_with_parent
from services.system.process_stat import process_stat
from tests.conftest import wait_until

SPIN = "while True: pass"
WAIT = "import sys; sys.stdin.read()"
IN_A_THREAD = """
import threading
def spin():
    while True: pass
threading.Thread(target=spin).start()
"""
IN_A_COPY = """
import os
from services.system.lifeline import die_with_parent
if os.fork():
    os.wait()
die_with_parent()
while True: pass
"""


@contextmanager
def running(program: str, *, last: bool = False) -> Iterator[int]:
    """A process; ``last`` gets no processor while anybody else wants one."""

    def begin() -> None:
        die_with_parent()
        if last:
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))

    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, preexec_fn=begin) as one:  # noqa: PLW1509 - two system calls
        try:
            wait_until(lambda: process_stat(one.pid).cpu_s > 0.01, 30)
            yield one.pid
        finally:
            one.kill()


@pytest.mark.parametrize(
    ("program", "expected"), [(SPIN, True), (IN_A_THREAD, True), (IN_A_COPY, True), (WAIT, False)]
)
def test_a_process_computes_or_waits(program: str, expected: bool) -> None:
    with running(program) as pid, running(WAIT) as another:
        wait_until(lambda: computes([another, pid]) == expected, 30)


def test_who_waits_for_a_processor_has_something_to_compute() -> None:
    with running(SPIN, last=True) as starved, ExitStack() as others:
        for _ in range(2 * len(os.sched_getaffinity(0))):
            others.enter_context(running(SPIN))
        assert computes([starved])


def test_nobody_computes_once_all_have_ended() -> None:
    with running(SPIN) as pid:
        pass
    assert not computes([pid])


class Flight:
    """Processes that are watched; their processor time is told as it stands in ``used_s``."""

    def __init__(self, *pids: int) -> None:
        self._pids, self.used_s, self.stopped = list(pids), 0.0, list[str]()

    def refresh(self) -> list[str]:
        return self.stopped

    def pids(self) -> list[int]:
        return self._pids

    def cpu_s(self) -> float:
        return self.used_s


def test_silence_is_a_stall_if_nobody_computes_or_somebody_does_so_without_end() -> None:
    with running(SPIN) as busy, running(WAIT) as idle:
        for pid, used_s, expected in ((idle, 0.0, True), (busy, 15.0, False), (busy, 36.0, True)):
            flight = Flight(pid)
            heard = Silence(flight, most_cpu_s=15.0)
            heard.look(0.05, heard=True)
            for _ in range(20):
                heard.look(1.0, heard=False)
                assert not heard.is_stall()
            flight.used_s = used_s
            heard.look(1.0, heard=False)
            assert heard.is_stall() == expected
            assert not heard.is_stall(), "it begins anew"


def test_a_message_ends_the_silence() -> None:
    heard = Silence(Flight(), most_cpu_s=15.0)
    for second in range(60):
        heard.look(1.0, heard=second % 20 == 19)
        assert not heard.is_stall()


def test_a_machine_that_stood_still_counts_as_one_second() -> None:
    heard = Silence(Flight(), most_cpu_s=15.0)
    heard.look(3600.0, heard=False)
    assert not heard.is_stall()


def test_who_was_stopped_may_go_on_for_a_while() -> None:
    flight = Flight()
    heard = Silence(flight, most_cpu_s=15.0)
    for _ in range(15):
        heard.look(1.0, heard=False)
    flight.stopped = ["planning"]
    for _ in range(20):
        heard.look(1.0, heard=False)
    flight.stopped = []
    for _ in range(20):
        heard.look(1.0, heard=False)
    assert not heard.is_stall()
    heard.look(1.0, heard=True)
    flight.stopped = ["planning", "control"]
    for _ in range(20):
        heard.look(1.0, heard=False)
    with pytest.raises(DisturbedFlightError, match="planning, control was stopped from outside"):
        heard.look(1.0, heard=False)
