"""Worlds: bounds, obstacles, start and goal of a mission, made from a name and a seed.

World frame: x east, y north, z up, metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from services.bus.rng import generator

AREA_M = 100.0
"""Side of the square area, centred on the origin: ten cells by ten."""

CELL_M = 10.0
"""Side of a grid cell, which holds one obstacle or none (paper, section VI)."""

CEILING_M = 10.0
"""Flight ceiling: the planner's upper limit (facts page, "planner")."""

OBSTACLE_TOP_M = 20.0
"""Stands for the paper's unbounded height: twice the flight ceiling."""

START_M = (-25.0, 5.0, 2.0)
GOAL_M = (25.0, 5.0, 2.0)
"""50 m apart (facts page, "mission"), along the middle of a row of cells: on the border between
two rows obstacles would at most graze the straight line."""

KEEP_OUT_M = 3.0
"""No obstacle stands closer to start or goal: the safety body and as much again."""

SAFETY_RADIUS_M = 1.5
"""Radius of the body that the collision check keeps free (facts page, "collision check")."""


class UnknownWorldError(ValueError):
    """A world was asked for by a name that is not in ``WORLDS``."""


@dataclass(frozen=True, slots=True)
class GridWorld:
    """Parameters of the paper's generator: obstacles scattered over the cells of a grid.

    ``density`` is the probability that a cell holds an obstacle, ``obstacle_m`` the side of its
    square cross-section.
    """

    density: float
    obstacle_m: float


WORLDS: Mapping[str, GridWorld] = MappingProxyType({"sparse": GridWorld(density=0.05, obstacle_m=3.0)})
"""Every world that a mission can name."""


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A mission's surroundings. All arrays are float64 and read-only.

    ``bounds`` is (2, 3): lower and upper corner of the space to fly in. ``obstacles`` is (n, 6):
    lower corner x y z, upper corner x y z of axis-aligned boxes. ``start`` and ``goal`` are (3,).
    """

    name: str
    seed: int
    bounds: NDArray[np.float64]
    obstacles: NDArray[np.float64]
    start: NDArray[np.float64]
    goal: NDArray[np.float64]

    def __post_init__(self) -> None:
        for array in (self.bounds, self.obstacles, self.start, self.goal):
            array.setflags(write=False)


def make_world(name: str, seed: int) -> World:
    """The world ``name`` as drawn from ``seed``: the same arguments give the same bytes.

    At the paper's density of one cell in twenty most draws leave the straight line from start to
    goal free, and on such a flight neither collision check nor replanning has anything to do. So a
    draw counts only if that line comes within the safety radius of an obstacle; else the next
    attempt is drawn, with a stream of its own. No world is therefore without obstacles.

    :raises UnknownWorldError: if ``WORLDS`` has no such name.
    """
    if name not in WORLDS:
        message = f"unknown world {name!r}; known: {', '.join(sorted(WORLDS))}"
        raise UnknownWorldError(message)
    start, goal = np.array(START_M), np.array(GOAL_M)
    for attempt in count():
        obstacles = _scatter(WORLDS[name], generator(seed, f"world {name}", attempt))
        near = _meets(obstacles, start, start, KEEP_OUT_M) | _meets(obstacles, goal, goal, KEEP_OUT_M)
        obstacles = np.ascontiguousarray(obstacles[~near])
        if _meets(obstacles, start, goal, SAFETY_RADIUS_M).any():
            break
    half = AREA_M / 2
    bounds = np.array([[-half, -half, 0.0], [half, half, CEILING_M]])
    return World(name=name, seed=seed, bounds=bounds, obstacles=obstacles, start=start, goal=goal)


def _scatter(grid: GridWorld, rng: np.random.Generator) -> NDArray[np.float64]:
    """Boxes (n, 6), each at a uniform position inside its cell, in the order of the cells."""
    cells = round(AREA_M / CELL_M)
    occupied = rng.random((cells, cells)) < grid.density
    offset = rng.uniform(0.0, CELL_M - grid.obstacle_m, (cells, cells, 2))
    corner = np.argwhere(occupied) * CELL_M - AREA_M / 2 + offset[occupied]
    ground = np.zeros((len(corner), 1))
    return np.hstack([corner, ground, corner + grid.obstacle_m, ground + OBSTACLE_TOP_M])


def _meets(
    obstacles: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64], margin_m: float
) -> NDArray[np.bool_]:
    """For each box, whether the segment from ``a`` to ``b`` meets the box grown by ``margin_m``."""
    direction = b - a
    still = direction == 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (obstacles[:, :3] - margin_m - a) / direction
        second = (obstacles[:, 3:] + margin_m - a) / direction
    # An axis along which the segment does not move limits it nowhere or everywhere.
    inside = (obstacles[:, :3] - margin_m <= a) & (a <= obstacles[:, 3:] + margin_m)
    enter = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(first, second))
    leave = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(first, second))
    met: NDArray[np.bool_] = np.maximum(enter.max(axis=1), 0.0) <= np.minimum(leave.min(axis=1), 1.0)
    return met
