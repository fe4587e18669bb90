"""The clock of a flight in real time: wall time since its first tick, less the injector's pauses."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

_EPOCH, _PAUSED = range(2)


class FlightClock:
    """One clock for all processes of a flight, in a page of memory that they share.

    It stands at 0 until the simulator begins. Lockstep flights have none: their time is virtual.
    """

    def __init__(self, path: Path) -> None:
        self._page = np.memmap(path, dtype=np.int64, mode="r+", shape=(2,))

    @classmethod
    def create(cls, path: Path) -> FlightClock:
        """A new clock in a file of its own."""
        path.write_bytes(bytes(16))
        return cls(path)

    def begin(self) -> None:
        """Start the clock: the time of the flight runs from 0."""
        self._page[_EPOCH] = time.monotonic_ns()

    def now_ns(self) -> int:
        """The time of the flight in nanoseconds."""
        if not self._page[_EPOCH]:
            return 0
        return int(time.monotonic_ns() - self._page[_EPOCH] - self._page[_PAUSED])

    def leave_out(self, pause_ns: int) -> None:
        """Take a pause, in which every node stood, out of the time of the flight."""
        self._page[_PAUSED] += pause_ns
