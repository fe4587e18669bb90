"""Where obstacles that move are at a virtual time, compiled: it is asked for every tick."""

from __future__ import annotations

import numpy as np
from numba import njit

from sim.moving import Floats


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
