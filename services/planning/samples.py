"""Planning's kernels on a plan that was made in flight, around a collision that was found ahead."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bus.arrays import Plan, plan, xyz
from services.bus.octomaps import known
from services.planning.frontier import frontier
from services.planning.pilot import PlanRequest
from services.planning.planners import plan as find_path
from services.planning.sweep import lawn_mower
from services.planning.trajectory import Departure, trajectory
from services.planning.voxels import NEAR, VoxelGrid, unpack
from services.runtime import rng
from services.runtime.kernel_trial import KernelTrial, NoSampleError, Sample, SampleFlight, cdr, decoded

_DETOUR = 1.05  # of the straight way, at least
_SPACING_M = 4.0
_AROUND_M = 15.0
_MAPS = 8
"""Before a trajectory, among which is the one that it was planned in."""


def record(flight: SampleFlight) -> Sample:
    """The first trajectory that was planned in flight to lead around something.

    Its input is the state at a row of the trajectory before it, and one of the maps before it; the right
    one gives the trajectory of the flight again, to the bit.

    :raises NoSampleError: if there is no such trajectory.
    """
    messages = flight.messages
    goal = xyz(decoded("goal", cdr(messages["goal"][0])).position)
    plans = [(one, plan(decoded("trajectory", cdr(one)))) for one in messages["trajectory"]]
    for (_, before), (made_at, made) in itertools.pairwise(plans):
        departure = _departure(before, made)
        if departure is None:
            continue
        known = [one for one in messages["map"] if one.ready_ns <= made_at.ready_ns]
        seed = rng.native_seed(flight.spec.seed, "planner", made.trajectory_seq)
        for newest in reversed(known[-_MAPS:]):
            sample = _sample(flight, departure, goal, seed, cdr(newest))
            if _gives(sample, made, flight.spec.planner) and _leads_around(sample):
                return sample
    raise NoSampleError("no trajectory was planned in flight to lead around something")


def _departure(before: Plan, made: Plan) -> NDArray[np.float64] | None:
    """The row of ``before`` at which ``made`` begins, if it begins in flight."""
    if not len(made.points) or not made.points[0, 4:7].any():
        return None
    rows = before.points[before.points[:, 0] == made.points[0, 0]] if len(before.points) else before.points
    return rows[0] if len(rows) else None


def _sample(
    flight: SampleFlight,
    departure: NDArray[np.float64],
    goal: NDArray[np.float64],
    seed: int,
    octomap: NDArray[np.uint8],
) -> dict[str, NDArray[Any]]:
    motion = flight.spec.motion
    sample = {
        "departure": departure,
        "goal": goal,
        "seed": np.array(seed),
        "limits": np.array([motion.speed_m_s, motion.acceleration_m_s2]),
        "map": octomap,
    }
    path = PlannerTrial(flight.spec.planner, sample)
    path.run()
    return sample | {"path": np.empty((0, 3)) if path.path is None else path.path}


def _gives(sample: Sample, made: Plan, planner: str) -> bool:
    """Whether the kernels reproduce from the sample what was made in flight."""
    if not len(sample["path"]):
        return False
    smoothing = SmoothingTrial(planner, sample)
    smoothing.run()
    return smoothing.rows is not None and np.array_equal(smoothing.rows, made.points)


def _leads_around(sample: Sample) -> bool:
    path = sample["path"]
    legs = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return bool(legs.sum() > _DETOUR * np.linalg.norm(path[-1] - path[0]))


class PlannerTrial(KernelTrial):
    """One planner's path around what is in the way: corners (n, 3), m."""

    def __init__(self, kernel: str, sample: Sample) -> None:
        self._planner = kernel
        self._seed = int(sample["seed"])
        self._grid, self._departure = problem(sample)
        self._goal = sample["goal"]
        self.path: NDArray[np.float64] | None = None

    def run(self) -> None:
        """Plan a path from the sample's start to its goal."""
        self.path = find_path(
            self._planner, self._grid, self._departure.position, self._goal, self._seed, NEAR
        )

    def values(self) -> NDArray[Any]:
        """The path; without rows if there is none."""
        return np.empty((0, 3)) if self.path is None else self.path


class SweepTrial(KernelTrial):
    """The lanes over the space between the vehicle and its goal, and some more: their ends (2n, 3), m."""

    def __init__(self, _: str, sample: Sample) -> None:
        departure = problem(sample)[1]
        self._low, self._high = _area(departure, sample["goal"])
        self._start = departure.position
        self.ends = np.empty((0, 3))

    def run(self) -> None:
        """Compute the lanes of the sweep."""
        self.ends = lawn_mower(self._low, self._high, self._start, _SPACING_M)

    def values(self) -> NDArray[Any]:
        """The ends of the lanes, in the order in which they are flown."""
        return self.ends


class FrontierTrial(KernelTrial):
    """The place from which to see more of that space: (1, 3), m."""

    def __init__(self, _: str, sample: Sample) -> None:
        self._grid, self._departure = problem(sample)
        self._area = _area(self._departure, sample["goal"])
        octomap = decoded("map", sample["map"])
        box = _request(self._departure, sample["goal"]).box()
        self._known = known(octomap.data.tobytes(), octomap.resolution, *box)
        self.place = np.empty(0)

    def run(self) -> None:
        """Choose the frontier to fly to."""
        grid = self._grid
        around = grid.levels, self._known, grid.origin, grid.resolution_m
        self.place = frontier(*around, *self._area, self._departure.position, np.empty((0, 3)))

    def values(self) -> NDArray[Any]:
        """The place; without rows if there is none."""
        return self.place.reshape(-1, 3)


class SmoothingTrial(KernelTrial):
    """The trajectory along the path that the flight's planner found: rows (n, 12), as on the bus."""

    def __init__(self, _: str, sample: Sample) -> None:
        self._grid, self._departure = problem(sample)
        self._path = sample["path"]
        self._limits = [float(limit) for limit in sample["limits"]]
        self.rows: NDArray[np.float64] | None = None

    def run(self) -> None:
        """Smooth the path of the sample into a trajectory."""
        self.rows = trajectory(self._path, self._departure, self._grid, NEAR, *self._limits)

    def values(self) -> NDArray[Any]:
        """The trajectory; without rows if there is none."""
        return np.empty((0, 12)) if self.rows is None else self.rows


def problem(sample: Sample) -> tuple[VoxelGrid, Departure]:
    """The grid to plan in, and the state to plan from."""
    row = sample["departure"]
    departure = Departure(float(row[0]), row[1:4], row[4:7], row[7:10], float(row[10]))
    octomap = decoded("map", sample["map"])
    box = _request(departure, sample["goal"]).box()
    return unpack(octomap.data.tobytes(), octomap.resolution, *box), departure


def _request(departure: Departure, goal: NDArray[np.float64]) -> PlanRequest:
    return PlanRequest(departure, goal, 0, 0, NEAR, retreat=False)


def _area(departure: Departure, goal: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (3,) of the space between vehicle and goal and ``_AROUND_M`` beside it, at one height."""
    low = np.minimum(departure.position, goal) - _AROUND_M
    high = np.maximum(departure.position, goal) + _AROUND_M
    low[2] = high[2] = departure.position[2]
    return low, high
