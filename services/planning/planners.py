"""Kernels: sampling-based planners of OMPL on a voxel grid, then shortcuts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from ompl import base, geometric
from ompl import util as ompl_util

from services.models.plug_ins import OmplPlanner
from services.planning.polyline import shorten
from services.planning.roadmap import shortest
from services.planning.voxels import NEAR, OCCUPIED, VoxelGrid, edge_clear, level_at
from services.system import plug_ins

ompl_util.noOutputHandler()

PLANNERS: Mapping[str, type] = MappingProxyType(
    {
        "rrt": geometric.RRT,
        "rrt_connect": geometric.RRTConnect,
        "rrt_star": geometric.RRTstar,
        "prm_star": geometric.PRMstar,
    }
)

ITERATIONS = 600
"""Budget of one plan: iterations, not seconds, so that it is the same on every machine."""

EDGE_M = 8.0
"""Longest edge of the tree."""

GOOD_ENOUGH = 1.02
"""RRT* stops at a path this many times as long as the straight line."""

CLIMB_WEIGHT = 3.0
"""A metre up or down counts as much as these many sideways: the camera looks ahead, and 29 degrees
above and below is all that it sees of where a climb leads."""

NEAREST_OPEN_M = 6.0
"""How far from a blocked start or goal an open voxel is looked for."""

_NO_WAY_M = 1e-6
"""Nearer ends than these need no search; RRT* raises an error where both are one place."""

# From metres to the space that OMPL searches.
_METRIC: NDArray[np.float64] = np.array([1.0, 1.0, CLIMB_WEIGHT])


def plan(
    planner: str,
    grid: VoxelGrid,
    start: NDArray[np.float64],
    goal: NDArray[np.float64],
    seed: int,
    limit: int = NEAR,
    iterations: int = ITERATIONS,
) -> NDArray[np.float64] | None:
    """A path from ``start`` to ``goal`` (3,), world frame, as corners (n, 3), or None.

    ``planner`` is a name in ``PLANNERS`` or of a planner that another package adds; the grid's box is where
    it looks. Voxels of level ``limit`` and above are blocked, except that a start in one is left by the
    straight line to the nearest open voxel. A goal that is blocked is replaced by the nearest open voxel.
    None if there is no such voxel, or no path within the budget. The same arguments give the same path.
    """
    entry = nearest_open(grid, start, limit)
    target = nearest_open(grid, goal, limit)
    if entry is None or target is None:
        return None
    found: NDArray[np.float64] | None = np.array([entry, target])
    if np.linalg.norm(target - entry) > _NO_WAY_M:
        found = _search(planner, grid, entry, target, seed, limit, iterations)
    if found is None:
        return None
    path = shorten(found, grid.levels, grid.origin, grid.resolution_m, limit)
    return path if np.array_equal(entry, start) else np.vstack((start, path))


def nearest_open(grid: VoxelGrid, point: NDArray[np.float64], limit: int) -> NDArray[np.float64] | None:
    """``point`` itself if its voxel is below ``limit``, else the centre of the nearest such in reach.

    In reach means that the straight line there crosses no occupied voxel; leaving the voxel of
    ``point``, whatever is in it, is allowed.
    """
    if grid.level(point) < limit:
        return point
    found = _nearest_open(grid.levels, grid.origin, grid.resolution_m, point, limit, NEAREST_OPEN_M)
    return found if len(found) else None


def _search(
    planner: str,
    grid: VoxelGrid,
    start: NDArray[np.float64],
    goal: NDArray[np.float64],
    seed: int,
    limit: int,
    iterations: int,
) -> NDArray[np.float64] | None:
    """Corners of the path that OMPL finds within the budget, if any."""
    ompl_util.RNG.setSeed(seed or 1)  # before anything that draws is made; OMPL takes no notice of 0
    low = grid.origin * _METRIC
    high = low + np.array(grid.levels.shape) * grid.resolution_m * _METRIC
    ends = (start * _METRIC, goal * _METRIC)
    space = base.RealVectorStateSpace(3)
    bounds = base.RealVectorBounds(3)
    for axis in range(3):
        bounds.setLow(axis, float(low[axis]))
        bounds.setHigh(axis, float(high[axis]))
    space.setBounds(bounds)
    # Not OMPL's SimpleSetup: it keeps how long its planner took, a clock reading in the node's memory.
    information = base.SpaceInformation(space)
    validator = _EdgeValidator(information, grid, limit)
    information.setMotionValidator(validator)
    information.setStateValidityChecker(validator.state_clear)
    objective = base.PathLengthOptimizationObjective(information)
    objective.setCostThreshold(base.Cost(GOOD_ENOUGH * float(np.linalg.norm(ends[1] - ends[0]))))
    problem = base.ProblemDefinition(information)
    problem.setOptimizationObjective(objective)
    states = (space.allocState(), space.allocState())
    for state, point in zip(states, ends, strict=True):
        for axis in range(3):
            state[axis] = float(point[axis])
    problem.setStartAndGoalStates(*states)
    algorithm = _made(planner, information)
    ompl_util.RNG()  # OMPL seeds one after the other, and SimpleSetup made one here
    if hasattr(algorithm, "setRange"):
        algorithm.setRange(EDGE_M)
    if isinstance(algorithm, geometric.RRTstar):
        algorithm.setFocusSearch(True)  # only where the path that it has could still be shortened
    information.setup()
    algorithm.setProblemDefinition(problem)
    algorithm.setup()
    if isinstance(algorithm, geometric.PRMstar):
        found = shortest(algorithm, information, *ends, validator.clear, iterations)
        return None if found is None else found / _METRIC
    budget = _Budget(iterations)
    algorithm.solve(base.PlannerTerminationCondition(budget.spent))
    if not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    corners = [path.getState(i) for i in range(path.getStateCount())]
    return np.array([[state[axis] for axis in range(3)] for state in corners]) / _METRIC


def _made(planner: str, information: Any) -> Any:
    if planner in PLANNERS:
        return PLANNERS[planner](information)
    added: OmplPlanner = plug_ins.load("planners", planner)
    return added.make(information)


class _EdgeValidator(base.MotionValidator):  # type: ignore[misc]
    """OMPL's question whether an edge is free, answered by one walk through the grid."""

    def __init__(self, information: Any, grid: VoxelGrid, limit: int) -> None:
        super().__init__(information)
        self._limit = limit
        self._grid = (grid.levels, grid.origin, grid.resolution_m)

    def clear(self, a: Any, b: Any) -> bool:
        z = (a[2] / CLIMB_WEIGHT, b[2] / CLIMB_WEIGHT)
        return bool(edge_clear(*self._grid, a[0], a[1], z[0], b[0], b[1], z[1], self._limit))

    checkMotion = clear  # noqa: N815 - OMPL's name

    def state_clear(self, state: Any) -> bool:
        return bool(level_at(*self._grid, state[0], state[1], state[2] / CLIMB_WEIGHT) < self._limit)


class _Budget:
    """Counts down the iterations; OMPL asks once in each."""

    def __init__(self, iterations: int) -> None:
        self._left = iterations

    def spent(self) -> bool:
        self._left -= 1
        return self._left < 0


@njit(cache=True)
def _nearest_open(
    levels: NDArray[np.uint8],
    origin: NDArray[np.float64],
    resolution: float,
    point: NDArray[np.float64],
    limit: int,
    reach: float,
) -> NDArray[np.float64]:
    """Centre of the nearest voxel in reach below ``limit`` as an array (3,), or an empty array."""
    found = np.empty(0)
    nearest = reach
    span = math.ceil(reach / resolution)
    base_voxel = np.floor((point - origin) / resolution).astype(np.int64)
    centre = np.empty(3)
    nx, ny, nz = levels.shape
    for i in range(max(base_voxel[0] - span, 0), min(base_voxel[0] + span + 1, nx)):
        for j in range(max(base_voxel[1] - span, 0), min(base_voxel[1] + span + 1, ny)):
            for k in range(max(base_voxel[2] - span, 0), min(base_voxel[2] + span + 1, nz)):
                if levels[i, j, k] >= limit:
                    continue
                centre[0] = origin[0] + (i + 0.5) * resolution
                centre[1] = origin[1] + (j + 0.5) * resolution
                centre[2] = origin[2] + (k + 0.5) * resolution
                distance = math.sqrt(np.sum((centre - point) ** 2))
                if distance < nearest and _escapes(levels, origin, resolution, centre, point):
                    nearest = distance
                    found = centre.copy()
    return found


@njit(cache=True)
def _escapes(
    levels: NDArray[np.uint8],
    origin: NDArray[np.float64],
    resolution: float,
    inside: NDArray[np.float64],
    point: NDArray[np.float64],
) -> bool:
    """Whether the line from ``inside`` to ``point`` meets no occupied voxel but that of ``point``.

    What lies outside the grid (the ground below a vehicle about to take off) does not count.
    """
    nx, ny, nz = levels.shape
    own = np.floor((point - origin) / resolution)
    steps = 4 * math.ceil(math.sqrt(np.sum((point - inside) ** 2)) / resolution)
    for step in range(steps):
        at = np.floor((inside + (point - inside) * (step / steps) - origin) / resolution)
        i, j, k = int(at[0]), int(at[1]), int(at[2])
        within = 0 <= i < nx and 0 <= j < ny and 0 <= k < nz
        if within and levels[i, j, k] == OCCUPIED and not np.array_equal(at, own):
            return False
    return True
