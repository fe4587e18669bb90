"""Time spent by what, measured so that no reading of a clock comes into the process's own memory.

A fault may make a kernel read any of it, a freed block as well: what lies there is the same in every flight.
So the readings lie on the page that is shared with the supervisor, and are added up there.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from services.system.shared_stats import OTHER

_NS: NDArray[np.int64] = np.array([1_000_000_000, 1])
"""A clock is read as seconds and ns (struct timespec)."""

_clock_gettime = ctypes.CDLL(None).clock_gettime
_clock_gettime.argtypes = [ctypes.c_int, ctypes.c_void_p]


class Stopwatch:
    """Adds up the time from lap to lap, each to what was done in it; :meth:`restart` comes first.

    ``page`` is one of :class:`services.system.shared_stats.SharedStats`, ``field`` its field with the
    sums, ns; ``clock`` is ``CLOCK_MONOTONIC`` or ``CLOCK_THREAD_CPUTIME_ID`` (clock_gettime(2)).
    """

    def __init__(self, page: np.void, clock: int, field: Literal["wall_ns", "cpu_ns"]) -> None:
        self._clock = clock
        self._last, self._now, lap = page["readings"][("wall_ns", "cpu_ns").index(field)]
        self._now_at = self._now.ctypes.data
        self.lap_ns: NDArray[np.int64] = lap[:1]
        """What the last lap took, an array (1,) on the page."""
        self._sums = [page[field][place : place + 1] for place in range(len(page[field]))]

    def restart(self) -> None:
        """Begin a lap now; the time since the last one goes nowhere."""
        self._read()
        np.copyto(self._last, self._now)

    def lap(self, place: int) -> None:
        """End a lap and begin the next: the time of what ends goes to the sum at ``place``."""
        self._read()
        np.subtract(self._now, self._last, out=self._last)
        np.multiply(self._last, _NS, out=self._last)
        np.add(self._last[:1], self._last[1:], out=self.lap_ns)
        np.add(self._sums[place], self.lap_ns, out=self._sums[place])
        np.copyto(self._last, self._now)

    def _read(self) -> None:
        _clock_gettime(self._clock, self._now_at)


class ActivityStopwatch(Stopwatch):
    """Wall time, all of it charged to one activity or another."""

    def __init__(self, page: np.void) -> None:
        super().__init__(page, time.CLOCK_MONOTONIC, "wall_ns")
        self._doing = OTHER
        self.restart()

    @contextmanager
    def busy_with(self, activity: int) -> Iterator[None]:
        """Charge what the ``with`` statement's body takes to an activity, and to no other."""
        before, self._doing = self._doing, activity
        self.lap(before)
        try:
            yield
        finally:
            self.lap(activity)
            self._doing = before


class KernelStopwatch(Stopwatch):
    """Processor time of the thread's kernel calls, and of its squares."""

    def __init__(self, page: np.void, clock: int) -> None:
        super().__init__(page, clock, "cpu_ns")
        squares, self._square = page["cpu_squares_ns2"], page["cpu_square_ns2"]
        self._squares = [squares[place : place + 1] for place in range(len(squares))]

    def lap(self, place: int) -> None:
        """End a call of the kernel at ``place``."""
        super().lap(place)
        np.copyto(self._square, self.lap_ns)
        np.multiply(self._square, self._square, out=self._square)
        np.add(self._squares[place], self._square, out=self._squares[place])
