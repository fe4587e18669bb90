"""Figures of a world as a place to fly in: density, free space, clearances, widest way to the goal.

Seen from above, at the height of the start: what does not reach up there is no obstacle to level flight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded when they are used
from numpy.typing import NDArray

from services.models.safety import BODY_RADIUS_M
from sim.world import World

RASTER_M = 0.25
CELL_M = 10.0
"""Of the paper's grid, by which density is counted."""


class WorldFigures(NamedTuple):
    """The figures of one world, lengths in metres.

    ``density``: part of the 10 m cells that an obstacle reaches into; ``free_space``: part of the area
    outside obstacles; ``room_to_fly``: part of it where the safety body fits; clearances in m to the nearest
    obstacle; ``widest_way_m``: the least clearance on the way from start to goal on which that is greatest,
    0 if there is no way.
    """

    obstacles: int
    density: float
    free_space: float
    room_to_fly: float
    start_clearance_m: float
    goal_clearance_m: float
    widest_way_m: float


def survey(world: World) -> WorldFigures:
    """The figures of a world, to about a raster's width of 0.25 m."""
    low, high = world.bounds
    shape = np.maximum(((high - low)[:2] / RASTER_M).astype(int), 1)
    x, y = (low[axis] + (np.arange(shape[axis]) + 0.5) * RASTER_M for axis in (0, 1))
    clearance = clearances(world, x, y)
    start, goal = (
        tuple(np.clip(((end - low)[:2] / RASTER_M).astype(int), 0, shape - 1))
        for end in (world.start, world.goal)
    )
    return WorldFigures(
        obstacles=len(world.obstacles),
        density=_density(world),
        free_space=float((clearance > 0).mean()),
        room_to_fly=float((clearance >= BODY_RADIUS_M).mean()),
        start_clearance_m=float(clearance[start]),
        goal_clearance_m=float(clearance[goal]),
        widest_way_m=_widest(clearance, start, goal),
    )


def clearances(world: World, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Level distance (nx, ny) to the nearest obstacle at the height of the start; 0 inside one."""
    nearest = np.full((len(x), len(y)), np.inf)
    for box in world.obstacles:
        if box[2] <= world.start[2] <= box[5]:
            dx = np.maximum(np.maximum(box[0] - x, x - box[3]), 0.0)
            dy = np.maximum(np.maximum(box[1] - y, y - box[4]), 0.0)
            nearest = np.minimum(nearest, np.hypot(dx[:, None], dy[None, :]))
    return nearest


def _density(world: World) -> float:
    low, high = world.bounds[0, :2], world.bounds[1, :2]
    shape = np.maximum(((high - low) / CELL_M).astype(int), 1)
    held = np.zeros(shape, dtype=bool)
    for box in world.obstacles:
        first = np.floor((box[:2] - low) / CELL_M).astype(int)
        last = np.ceil((box[3:5] - low) / CELL_M).astype(int)
        first, last = np.clip(first, 0, shape), np.clip(last, 0, shape)
        held[first[0] : last[0], first[1] : last[1]] = True
    return float(held.mean())


def _widest(clearance: NDArray[np.float64], start: tuple[int, ...], goal: tuple[int, ...]) -> float:
    """The largest clearance at which start and goal are in one connected region, by bisection."""
    low, high = 0.0, float(min(clearance[start], clearance[goal], 100.0))
    if not _joined(clearance > 0.0, start, goal):
        return 0.0
    while high - low > RASTER_M / 4:
        middle = (low + high) / 2
        low, high = (middle, high) if _joined(clearance >= middle, start, goal) else (low, middle)
    return low


def _joined(region: NDArray[np.bool_], start: tuple[int, ...], goal: tuple[int, ...]) -> bool:
    labels, _ = scipy.ndimage.label(region)
    return bool(labels[start] == labels[goal] != 0)
