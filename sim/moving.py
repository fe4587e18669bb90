"""Obstacles that move: where they are follows from the virtual time alone.

A moving obstacle goes back and forth on a straight line at a constant speed.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.models.world import MovingBox

Floats = NDArray[np.float64]

MOVING_WIDTH = 11
"""Numbers of a moving obstacle: box at one end of its line (6), way to the other (3), period, phase."""

NONE_MOVING: Floats = np.empty((0, MOVING_WIDTH))
NONE_MOVING.setflags(write=False)


def rows_of(given: tuple[MovingBox, ...]) -> Floats:
    """Moving obstacles (m, 11) of what a definition says."""
    rows = [(*one.box, *one.travel_m, one.period_s, one.phase) for one in given]
    return np.array(rows, dtype=np.float64).reshape(-1, MOVING_WIDTH)


@njit(cache=True)
def boxes_at(moving: Floats, time_s: float) -> Floats:
    """The boxes (m, 6) of the moving obstacles (m, 11) at a virtual time."""
    boxes = np.empty((len(moving), 6))
    for i in range(len(moving)):
        turn = (time_s / moving[i, 9] + moving[i, 10]) % 1.0
        part = 1.0 - abs(2.0 * turn - 1.0)
        for axis in range(3):
            shift = part * moving[i, 6 + axis]
            boxes[i, axis] = moving[i, axis] + shift
            boxes[i, 3 + axis] = moving[i, 3 + axis] + shift
    return boxes


def swept(moving: Floats) -> Floats:
    """The boxes (m, 6) that hold all places of the moving obstacles (m, 11)."""
    first, last = moving[:, :6], moving[:, :6] + np.tile(moving[:, 6:9], 2)
    return np.hstack([np.minimum(first, last)[:, :3], np.maximum(first, last)[:, 3:]])
