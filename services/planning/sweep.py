"""Kernel: the lawn-mower sweep over a rectangle (boustrophedon path; Choset 2001)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def lawn_mower(
    lower: NDArray[np.float64], upper: NDArray[np.float64], start: NDArray[np.float64], spacing_m: float
) -> NDArray[np.float64]:
    """Ends (2n, 3) of n parallel lanes that cover the level rectangle from ``lower`` to ``upper`` (3,).

    Points 2k and 2k + 1 are the ends of lane k; lanes lie along the longer side, evenly, at most
    ``spacing_m`` apart, and each runs against the one before. The first begins at the corner nearest
    to ``start`` (3,). Height is that of ``lower``.
    """
    along = 0 if upper[0] - lower[0] >= upper[1] - lower[1] else 1
    across = 1 - along
    lanes = max(math.ceil((upper[across] - lower[across]) / spacing_m), 1)
    near, far = lower.copy(), upper.copy()
    for axis in range(2):
        if abs(start[axis] - upper[axis]) < abs(start[axis] - lower[axis]):
            near[axis], far[axis] = upper[axis], lower[axis]
    step = (far[across] - near[across]) / lanes
    ends = np.empty((2 * lanes, 3))
    ends[:, 2] = lower[2]
    for lane in range(lanes):
        for end in range(2):
            ends[2 * lane + end, across] = near[across] + (lane + 0.5) * step
            ends[2 * lane + end, along] = far[along] if (lane + end) % 2 else near[along]
    return ends
