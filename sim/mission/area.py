"""The area of a mission: its corners and cells. Cheap to import: specifications are checked with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.models.mission import Area
from sim.world import BadWorldError, World

Floats = NDArray[np.float64]

DEFAULT_SIDE_M = 24.0
"""Shortest side of an area that nobody stated: three swaths of 8 m."""

CELL_M = 1.0


def corners(stated: Area, world: World) -> Floats:
    """Lower and upper corner (2, 3) of a mission's area, at the height of the world's start.

    By default it holds start and goal; a side that is too short then grows to where there is more room.

    :raises BadWorldError: if the area is empty, reaches beyond the world, or holds obstacles only.
    """
    ends = np.array([world.start[:2], world.goal[:2]])
    lower, upper = ends.min(axis=0), ends.max(axis=0)
    for axis in (0, 1):
        missing = max(DEFAULT_SIDE_M - (upper[axis] - lower[axis]), 0.0)
        below, above = lower[axis] - world.bounds[0, axis], world.bounds[1, axis] - upper[axis]
        if below >= above:
            lower[axis] -= min(missing, below)
        else:
            upper[axis] += min(missing, above)
    lower = lower if stated.lower is None else np.array(stated.lower)
    upper = upper if stated.upper is None else np.array(stated.upper)
    within = (world.bounds[0, :2] <= lower).all() and (upper <= world.bounds[1, :2]).all()
    area = np.array([[*lower, world.start[2]], [*upper, world.start[2]]])
    if not (lower < upper).all() or not within or not len(cells(area, world.obstacles)):
        message = (
            f"area: lower {lower.tolist()}, upper {upper.tolist()} is no free part of the world"
            f" {world.bounds[0, :2].tolist()} to {world.bounds[1, :2].tolist()}"
        )
        raise BadWorldError(message)
    return area


def cells(area: Floats, obstacles: Floats, margin_m: float = 0.0) -> Floats:
    """Centres (n, 3) of the area's cells that lie ``margin_m`` clear of the boxes (m, 6)."""
    sides = area[1, :2] - area[0, :2]
    counts = np.maximum(np.round(sides / CELL_M), 1.0)
    x, y = (area[0, axis] + (np.arange(counts[axis]) + 0.5) * (sides / counts)[axis] for axis in (0, 1))
    level = np.meshgrid(x, y, area[0, 2], indexing="ij")
    centres = np.stack(level, axis=-1).reshape(-1, 3)
    inside = np.zeros(len(centres), dtype=np.bool_)
    for box in obstacles:
        inside |= ((box[:3] - margin_m < centres) & (centres < box[3:] + margin_m)).all(axis=1)
    return np.ascontiguousarray(centres[~inside])
