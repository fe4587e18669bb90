"""Obstacles that move: where they are follows from the virtual time alone.

A moving obstacle goes back and forth on a straight line at a constant speed.
"""

from __future__ import annotations

import numpy as np
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


def swept(moving: Floats) -> Floats:
    """The boxes (m, 6) that hold all places of the moving obstacles (m, 11)."""
    first, last = moving[:, :6], moving[:, :6] + np.tile(moving[:, 6:9], 2)
    return np.hstack([np.minimum(first, last)[:, :3], np.maximum(first, last)[:, 3:]])
