"""Paths as polylines: detours cut off, legs divided."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.planning.voxels import edge_clear

_SHORTCUT_STEP_M = 1.0


@njit(cache=True)
def shorten(
    path: NDArray[np.float64],
    levels: NDArray[np.uint8],
    origin: NDArray[np.float64],
    resolution: float,
    limit: int,
) -> NDArray[np.float64]:
    """The path (n, 3) with detours cut off: forwards, then backwards, so that both ends are served.

    From each point the farthest later point in free sight is next; points lie every metre or closer.
    """
    for _ in range(2):
        dense = subdivide(path, _SHORTCUT_STEP_M)
        kept = np.empty_like(dense)
        kept[0] = dense[0]
        count, here = 1, 0
        while here < len(dense) - 1:
            there = len(dense) - 1
            while there > here + 1:
                a, b = dense[here], dense[there]
                if edge_clear(levels, origin, resolution, a[0], a[1], a[2], b[0], b[1], b[2], limit):
                    break
                there -= 1
            kept[count] = dense[there]
            count += 1
            here = there
        path = kept[:count][::-1].copy()
    return path


@njit(cache=True)
def subdivide(path: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """The path (n, 3) with points on its legs, at most ``step`` apart."""
    pieces = np.empty(len(path) - 1, dtype=np.int64)
    for leg in range(len(path) - 1):
        pieces[leg] = max(1, math.ceil(np.sqrt(np.sum((path[leg + 1] - path[leg]) ** 2)) / step))
    dense = np.empty((pieces.sum() + 1, 3))
    dense[0] = path[0]
    count = 1
    for leg in range(len(path) - 1):
        for piece in range(1, pieces[leg] + 1):
            dense[count] = path[leg] + (path[leg + 1] - path[leg]) * (piece / pieces[leg])
            count += 1
    return dense
