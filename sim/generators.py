"""Generators of graded worlds: forests, walls with gates, traffic.

Each has a ``difficulty`` from 0 to 1, from which its parameters follow unless they are given.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.models.safety import BODY_RADIUS_M
from services.models.world import DRAWN_TOP_M, ForestWorld, GatesWorld, TrafficWorld
from sim.moving import NONE_MOVING, Floats

WALL_M = 0.5
"""Thickness of a wall with a gate."""

BRANCH_M = (1.0, 3.0)
"""Length of a branch."""

BRANCH_HEIGHT_M = (0.5, 6.0)
"""Height of a branch: around the one at which flights are flown."""

ROUTE_M = (10.0, 24.0)
"""Length of a moving obstacle's line."""

SLOWEST = 0.7
"""Part of the stated speed at which the slowest obstacle moves."""

TRIES = 30
"""Places that are tried for a tree for each one that is wanted."""


class Scattered(NamedTuple):
    """What a generator drew: fixed boxes (n, 6) and moving obstacles (m, 11)."""

    fixed: Floats
    moving: Floats = NONE_MOVING


class ForestFigures(NamedTuple):
    """What a forest is drawn by: trees a hectare, thickness of trunks, least gap, branches a tree."""

    stems_per_ha: float
    trunk_m: float
    gap_m: float
    branches: float


class GateFigures(NamedTuple):
    """What gates are drawn by: walls, free width beside the safety body, greatest shift from the way."""

    walls: int
    clearance_m: float
    shift_m: float


class TrafficFigures(NamedTuple):
    """What traffic is drawn by: obstacles that move, their greatest speed and side, pillars."""

    movers: int
    speed_m_s: float
    obstacle_m: float
    pillars: int


def forest_figures(wanted: ForestWorld) -> ForestFigures:
    """The parameters of a forest: as given, else by its difficulty."""
    return ForestFigures(
        _given(wanted.stems_per_ha, _between(60.0, 400.0, wanted.difficulty)),
        _given(wanted.trunk_m, _between(0.6, 0.06, wanted.difficulty)),
        _given(wanted.gap_m, _between(6.0, 3.6, wanted.difficulty)),
        _given(wanted.branches, _between(1.0, 5.0, wanted.difficulty)),
    )


def gate_figures(wanted: GatesWorld) -> GateFigures:
    """The parameters of walls with gates: as given, else by the difficulty."""
    return GateFigures(
        wanted.walls if wanted.walls is not None else round(_between(1.0, 3.0, wanted.difficulty)),
        _given(wanted.clearance_m, _between(2.5, 0.5, wanted.difficulty)),
        _given(wanted.shift_m, _between(4.0, 12.0, wanted.difficulty)),
    )


def traffic_figures(wanted: TrafficWorld) -> TrafficFigures:
    """The parameters of traffic: as given, else by its difficulty."""
    return TrafficFigures(
        wanted.movers if wanted.movers is not None else round(_between(2.0, 6.0, wanted.difficulty)),
        _given(wanted.speed_m_s, _between(0.2, 0.8, wanted.difficulty)),
        wanted.obstacle_m,
        wanted.pillars,
    )


def _between(easy: float, hard: float, difficulty: float) -> float:
    return easy + (hard - easy) * difficulty


def _given(stated: float | None, otherwise: float) -> float:
    return otherwise if stated is None else stated


def forest_stems(wanted: ForestWorld) -> int:
    """How many trees are wanted in the area; fewer are found where they do not fit."""
    width, depth = (wanted.upper[axis] - wanted.lower[axis] for axis in (0, 1))
    return round(forest_figures(wanted).stems_per_ha * width * depth / 1e4)


def scatter_forest(wanted: ForestWorld, rng: np.random.Generator) -> Scattered:
    """Trees by dart throwing (Poisson-disk sampling): a trunk each, and level branches along x or y."""
    figures = forest_figures(wanted)
    low, high = np.array(wanted.lower), np.array(wanted.upper)
    count = forest_stems(wanted)
    stems = _apart(rng.uniform(low[:2], high[:2], (count * TRIES, 2)), figures.gap_m, count)
    half = figures.trunk_m / 2
    ground = np.full((len(stems), 1), low[2])
    trunks = np.hstack([stems - half, ground, stems + half, ground + DRAWN_TOP_M])
    return Scattered(np.vstack([trunks, _branches(stems, figures, low[2], rng)]))


def _apart(places: Floats, gap_m: float, count: int) -> Floats:
    """The first ``count`` of ``places`` (n, 2), in their order, that keep ``gap_m`` to those before."""
    kept = np.empty((count, 2))
    found = 0
    for place in places:
        if found == count:
            break
        if not found or np.hypot(*(kept[:found] - place).T).min() >= gap_m:
            kept[found] = place
            found += 1
    return kept[:found]


def _branches(stems: Floats, figures: ForestFigures, ground: float, rng: np.random.Generator) -> Floats:
    """Level branches (n, 6) from stems (m, 2), half as thick as a trunk."""
    bearing = np.repeat(stems, rng.poisson(figures.branches, len(stems)), axis=0)
    count, half = len(bearing), figures.trunk_m / 4
    axis, forwards = rng.integers(0, 2, count), rng.integers(0, 2, count) * 2 - 1
    tip = bearing.copy()
    tip[np.arange(count), axis] += forwards * rng.uniform(*BRANCH_M, count)
    height = ground + rng.uniform(*BRANCH_HEIGHT_M, (count, 1))
    return np.hstack(
        [np.minimum(bearing, tip) - half, height - half, np.maximum(bearing, tip) + half, height + half]
    )


def scatter_gates(wanted: GatesWorld, rng: np.random.Generator) -> Scattered:
    """A hall with walls across the way, evenly between start and goal, and a gate in each: as wide as the
    safety body with ``clearance_m`` on either side, its middle up to ``shift_m`` off the way.
    """
    figures = gate_figures(wanted)
    way = np.linspace(np.array(wanted.start), np.array(wanted.goal), figures.walls + 2)[1:-1]
    half = BODY_RADIUS_M + figures.clearance_m
    middle = way[:, 1] + rng.uniform(-figures.shift_m, figures.shift_m, figures.walls)
    middle = np.clip(middle, wanted.lower[1] + half, wanted.upper[1] - half)
    (west, south, bottom), (east, north, _) = wanted.lower, wanted.upper
    top = bottom + DRAWN_TOP_M
    # Closed around, or pilots would fly round the walls.
    walls = [
        (west, south - WALL_M, bottom, east, south, top),
        (west, north, bottom, east, north + WALL_M, top),
        (west - WALL_M, south - WALL_M, bottom, west, north + WALL_M, top),
        (east, south - WALL_M, bottom, east + WALL_M, north + WALL_M, top),
    ]
    for x, y in zip(way[:, 0].tolist(), middle.tolist(), strict=True):
        for first, last in ((south, y - half), (y + half, north)):
            if last > first:
                walls.append((x - WALL_M / 2, first, bottom, x + WALL_M / 2, last, top))
    return Scattered(np.array(walls))


def scatter_traffic(wanted: TrafficWorld, rng: np.random.Generator) -> Scattered:
    """Obstacles that cross the way from start to goal, back and forth, and pillars that stand beside it."""
    figures = traffic_figures(wanted)
    start, goal = np.array(wanted.start[:2]), np.array(wanted.goal[:2])
    along = (goal - start) / np.linalg.norm(goal - start)
    across = np.array([-along[1], along[0]])
    middle = start + _places(figures.movers, rng)[:, None] * (goal - start)
    turn = rng.uniform(-np.pi / 6, np.pi / 6, figures.movers)
    heading = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * along
    length = rng.uniform(*ROUTE_M, figures.movers)
    travel = heading * length[:, None]
    speed = figures.speed_m_s * rng.uniform(SLOWEST, 1.0, figures.movers)
    first = middle - travel / 2 + across * rng.uniform(-4.0, 4.0, (figures.movers, 1))
    moving = np.hstack(
        [
            _towers(first, figures.obstacle_m, wanted.lower[2]),
            travel,
            np.zeros((figures.movers, 1)),
            (2.0 * length / speed)[:, None],
            rng.random((figures.movers, 1)),
        ]
    )
    low, high = np.array(wanted.lower[:2]), np.array(wanted.upper[:2])
    standing = _towers(rng.uniform(low, high, (figures.pillars, 2)), figures.obstacle_m, wanted.lower[2])
    return Scattered(standing, moving)


def _places(count: int, rng: np.random.Generator) -> Floats:
    """Parts of the way, one in each of ``count`` equal sections of it, off its ends."""
    parts: NDArray[np.float64] = 0.15 + 0.7 * (np.arange(count) + rng.random(count)) / max(count, 1)
    return parts


def _towers(centre: Floats, side_m: float, ground: float) -> Floats:
    """Square towers (n, 6) around centres (n, 2)."""
    bottom = np.full((len(centre), 1), ground)
    return np.hstack([centre - side_m / 2, bottom, centre + side_m / 2, bottom + DRAWN_TOP_M])
