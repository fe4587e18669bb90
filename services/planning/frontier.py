"""Kernel: frontier-based exploration (Yamauchi 1997), the next best view by gain and way."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.bus.octomaps import UNKNOWN
from services.planning.voxels import NEAR, OCCUPIED

NEAREST_M = 3.0
"""A frontier nearer than this shows no more when the vehicle goes there."""

VIEW_M = 4.0
"""Within this much on each side of a frontier, unknown cells count as its gain."""

LEAST_GAIN_M2 = 2.0
"""Less is left alone: the inside of an obstacle, a gap between two rays."""

DETOUR_M = 5.0
"""Added to the way before gain is divided by it: what a stop and a turn cost."""

TRIED_M = 1.5
"""So near to a goal that was tried before, nothing new is to be seen."""

_ESCAPE_M = 3.0  # within this of the vehicle, cells too close to an obstacle may be crossed


@njit(cache=True)
def frontier(
    levels: NDArray[np.uint8],
    known: NDArray[np.uint8],
    origin: NDArray[np.float64],
    resolution: float,
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    position: NDArray[np.float64],
    tried: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The goal (3,) from which to see more of the area from ``lower`` to ``upper`` (3,), or empty.

    ``levels`` and ``known`` (nx, ny, nz) are what :mod:`services.planning.voxels` makes of the map,
    ``origin`` (3,) their lower corner; looked at is the layer of ``lower``'s height, where ``known``
    within a metre above and below counts as well. A frontier is a cell of the area that was seen, is
    clear, can be reached through such cells from ``position`` (3,), and has an unknown neighbour in the
    area. The best has the most unknown cells around it for each metre of way. Cells within ``TRIED_M``
    of ``tried`` (m, 3) are left out.
    """
    layer = int((lower[2] - origin[2]) / resolution)
    band = math.ceil(1.0 / resolution)
    nx, ny, _ = levels.shape
    seen = np.zeros((nx, ny), dtype=np.bool_)
    for k in range(max(layer - band, 0), min(layer + band + 1, levels.shape[2])):
        seen |= known[:, :, k] != UNKNOWN
    x = origin[0] + (np.arange(nx) + 0.5) * resolution
    y = origin[1] + (np.arange(ny) + 0.5) * resolution
    inside_x, inside_y = (x > lower[0]) & (x < upper[0]), (y > lower[1]) & (y < upper[1])
    missing = ~seen & np.outer(inside_x, inside_y)
    unknown = _sums(missing)
    way = _ways(levels[:, :, layer], seen, x, y, resolution, position)
    view = round(VIEW_M / resolution)
    best, found = 0.0, np.empty(0)
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            edge = missing[i - 1, j] or missing[i + 1, j] or missing[i, j - 1] or missing[i, j + 1]
            if not edge or not seen[i, j] or not (inside_x[i] and inside_y[j]) or way[i, j] < 0:
                continue
            if levels[i, j, layer] >= NEAR or math.hypot(x[i] - position[0], y[j] - position[1]) < NEAREST_M:
                continue
            gain = _count(unknown, i - view, i + view + 1, j - view, j + view + 1) * resolution**2
            score = gain / (way[i, j] * resolution + DETOUR_M)
            if gain < LEAST_GAIN_M2 or score <= best or _was_tried(tried, x[i], y[j]):
                continue
            best, found = score, np.array([x[i], y[j], lower[2]])
    return found


@njit(cache=True)
def _ways(
    levels: NDArray[np.uint8],
    seen: NDArray[np.bool_],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    resolution: float,
    position: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Cells to each cell (nx, ny) from the vehicle, step by step through clear ones; -1: no way."""
    nx, ny = levels.shape
    way = np.full((nx, ny), -1, dtype=np.int64)
    queue = np.empty((nx * ny, 2), dtype=np.int64)
    first = (
        math.floor((position[0] - x[0]) / resolution + 0.5),
        math.floor((position[1] - y[0]) / resolution + 0.5),
    )
    if not (0 <= first[0] < nx and 0 <= first[1] < ny):
        return way
    queue[0] = first
    way[first] = 0
    head, tail = 0, 1
    while head < tail:
        i, j = queue[head]
        head += 1
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            ii, jj = i + di, j + dj
            if not (0 <= ii < nx and 0 <= jj < ny) or way[ii, jj] >= 0 or not seen[ii, jj]:
                continue
            near = math.hypot(x[ii] - position[0], y[jj] - position[1]) < _ESCAPE_M
            if levels[ii, jj] < (OCCUPIED if near else NEAR):
                way[ii, jj] = way[i, j] + 1
                queue[tail] = ii, jj
                tail += 1
    return way


@njit(cache=True)
def _sums(cells: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Summed-area table (nx + 1, ny + 1)."""
    nx, ny = cells.shape
    sums = np.zeros((nx + 1, ny + 1), dtype=np.int64)
    for i in range(nx):
        for j in range(ny):
            sums[i + 1, j + 1] = cells[i, j] + sums[i, j + 1] + sums[i + 1, j] - sums[i, j]
    return sums


@njit(cache=True)
def _count(sums: NDArray[np.int64], i: int, ii: int, j: int, jj: int) -> int:
    """Cells in the rows i to ii and columns j to jj, ends excluded, as far as there are any."""
    i, j = max(i, 0), max(j, 0)
    ii, jj = min(ii, len(sums) - 1), min(jj, sums.shape[1] - 1)
    return int(sums[ii, jj] - sums[i, jj] - sums[ii, j] + sums[i, j])


@njit(cache=True)
def _was_tried(tried: NDArray[np.float64], x: float, y: float) -> bool:
    away = np.sqrt((tried[:, 0] - x) ** 2 + (tried[:, 1] - y) ** 2)
    return bool((away < TRIED_M).any())
