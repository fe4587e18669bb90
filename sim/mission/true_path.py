"""The true path of a flight, handed over in a file beside the bus: no digest has it, no node reads it.

Properties are judged by it after the flight (:mod:`deploy.mission.judgement`), not by what sensors said.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WIDTH = 6
"""Numbers of a row: time in s, position in m (3), speed in m/s, clearance in m."""


@dataclass(frozen=True, slots=True)
class TruePath:
    """The true states of a flight, one a physics step; the first is the start."""

    time_s: Floats
    position: Floats
    speed: Floats
    clearance: Floats


class PathWriter:
    """Writes a flight's true path to a file, which stays open until the process ends."""

    def __init__(self, file: Path) -> None:
        self._file = file.open("ab", buffering=0)

    def append(self, track: Floats, near: Floats) -> None:
        """Write the next stretch of a flight: a track (n, 14) and its clearances (n,).

        The first row of a track is the last one of the stretch before, so only the first stretch has it
        written. Each stretch is in the file when this returns: the simulator may be ended at any time.
        """
        rows = np.column_stack([track[:, :4], np.linalg.norm(track[:, 4:7], axis=1), near])
        self._file.write(rows[0 if track[0, 0] == 0.0 else 1 :].tobytes())


def read(file: Path, end_ns: int) -> TruePath:
    """The path up to and including ``end_ns`` of virtual time; without rows if nothing was flown."""
    numbers = np.fromfile(file) if file.exists() else np.empty(0)
    rows = numbers[: len(numbers) // WIDTH * WIDTH].reshape(-1, WIDTH)
    rows = rows[np.rint(rows[:, 0] * 1e9) <= end_ns]
    return TruePath(rows[:, 0], rows[:, 1:4], rows[:, 4], rows[:, 5])
