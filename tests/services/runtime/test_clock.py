"""The clock of a flight in real time: one for all processes, without the injector's pauses."""

import time
from pathlib import Path

from services.runtime.clock import FlightClock

PAUSE_NS = 10**12


def test_it_stands_until_it_begins(tmp_path: Path) -> None:
    clock = FlightClock.create(tmp_path / "clock")
    assert clock.now_ns() == 0
    time.sleep(0.001)
    assert clock.now_ns() == 0
    clock.begin()
    time.sleep(0.001)
    assert clock.now_ns() >= 1_000_000


def test_every_process_reads_the_same_time(tmp_path: Path) -> None:
    begun = FlightClock.create(tmp_path / "clock")
    other = FlightClock(tmp_path / "clock")
    begun.begin()
    first, second, third = begun.now_ns(), other.now_ns(), begun.now_ns()
    assert first <= second <= third


def test_a_pause_is_left_out(tmp_path: Path) -> None:
    clock = FlightClock.create(tmp_path / "clock")
    clock.begin()
    before = clock.now_ns()
    clock.leave_out(PAUSE_NS)
    assert clock.now_ns() < before - PAUSE_NS / 2
