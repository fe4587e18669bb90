"""Time is added up to what took it, and no reading of a clock lies in the process's own memory."""

import os
import signal
import struct
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from injector.tracing.process import MemoryMapping, Process, ProcessIdentity
from services.system.shared_stats import COMPUTING, OTHER, WAITING, SharedStats
from services.system.stopwatch import ActivityStopwatch, KernelStopwatch
from tests.conftest import wait_until


@pytest.fixture
def stats() -> Iterator[SharedStats]:
    with closing(SharedStats.create("node")) as page:
        yield page


def spin(seconds: float) -> None:
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_a_lap_goes_to_what_was_done_in_it(stats: SharedStats) -> None:
    before = time.monotonic_ns()
    watch = ActivityStopwatch(stats.page)
    time.sleep(0.001)
    with watch.busy_with(COMPUTING):
        time.sleep(0.002)
        with watch.busy_with(WAITING):
            time.sleep(0.02)
        time.sleep(0.002)
    spent = stats.page["wall_ns"].tolist()
    assert sum(spent) < time.monotonic_ns() - before
    assert spent[WAITING] >= 20_000_000
    assert spent[COMPUTING] >= 4_000_000
    assert spent[OTHER] >= 1_000_000


def test_processor_time_of_calls_and_its_squares(stats: SharedStats) -> None:
    watch = KernelStopwatch(stats.page, time.CLOCK_THREAD_CPUTIME_ID)
    laps = []
    for seconds in (0.003, 0.001):
        spin(0.002)  # before the call
        watch.restart()
        time.sleep(0.02)  # takes no processor time
        spin(seconds)
        watch.lap(5)
        laps.append(int(watch.lap_ns[0]))
    assert laps[0] >= 3_000_000
    assert laps[1] >= 1_000_000
    page = stats.page
    assert page["cpu_ns"].tolist() == [0] * 5 + [sum(laps)] + [0] * (len(page["cpu_ns"]) - 6)
    assert page["cpu_squares_ns2"][5] == pytest.approx(sum(lap**2 for lap in laps))


def test_no_reading_comes_into_the_own_memory(stats: SharedStats) -> None:
    child = os.fork()
    if child == 0:
        wall = ActivityStopwatch(stats.page)
        cpu = KernelStopwatch(stats.page, time.CLOCK_THREAD_CPUTIME_ID)
        cpu.restart()
        spin(0.05)
        for watch in (wall, cpu):
            watch.lap(0)
        stats.page["computing"] = 1
        while True:
            time.sleep(100)
    try:
        wait_until(lambda: bool(stats.page["computing"]))
        with Process(ProcessIdentity.of(child)) as process:
            memory = [process.read_memory(one.start, one.end - one.start) for one in own_memory(process)]
        for last, _, _ in stats.page["readings"].tolist():
            assert not any(shape in some for some in memory for shape in shapes(*last))
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def own_memory(process: Process) -> list[MemoryMapping]:
    return [one for one in process.maps().writable() if "p" in one.permissions]


def shapes(seconds: int, ns: int) -> Iterator[bytes]:
    """A clock's reading as it may lie in memory: as read, as a number, as an integer of Python's."""
    total, digit = seconds * 10**9 + ns, (1 << 30) - 1
    yield struct.pack("=qq", seconds, ns)
    yield struct.pack("=q", total)
    yield struct.pack("=d", total / 1e9)
    yield struct.pack("=II", total & digit, total >> 30 & digit)
