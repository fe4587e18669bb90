"""The kernels one after the other, without a bus, where the answer is known: a door, a box, a free field."""

import functools
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.control.pid import state_at
from services.kernels import KERNELS, PLANNERS
from services.models.safety import SPEED_LIMIT_M_S
from services.perception.collision import time_to_collision
from services.perception.occupancy import OccupancyMap
from services.perception.point_cloud import in_world, point_cloud
from services.planning.planners import CLIMB_WEIGHT, plan
from services.planning.samples import problem
from services.planning.trajectory import ACCELERATION_LIMIT_M_S2, Departure, trajectory
from services.planning.voxels import CLOSE, FREE, OCCUPIED, VoxelGrid, unpack
from tests.services.closed_loop import FOCAL_PX, HEIGHT, WIDTH, Boxes, render
from tests.services.planning.maps import GOAL, HIGH, LOW, START, open_space, wall_with_ends

every_planner = pytest.mark.parametrize("planner", PLANNERS)

FREE_FIELD: Boxes = np.empty((0, 4))
DOOR: Boxes = np.array([[14.0, 15.0, -20.0, -8.0], [14.0, 15.0, 0.0, 20.0]])
"""A wall across the whole space, 8 m of it open."""

CLOSED_BOX: Boxes = np.array([[-6.0, -5, -6, 6], [5, 6, -6, 6], [-6, 6, 5, 6], [-6, 6, -6, -5]])
ROUNDING = 1e-9


walled = functools.cache(wall_with_ends)


def seen(boxes: Boxes, places: list[tuple[float, float]]) -> OccupancyMap:
    """The map of a vehicle that has looked around at each of these places, level."""
    occupancy = OccupancyMap()
    centre = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    for x, y in places:
        position = np.array([x, y, 3.0])
        for yaw in np.arange(8) * math.pi / 4:
            attitude = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
            depth = render(boxes, position, yaw)
            scan = point_cloud(depth, FOCAL_PX, FOCAL_PX, *centre, occupancy.range_m)
            occupancy.insert(in_world(*scan, position, attitude), position)
    return occupancy


def grid_of(occupancy: OccupancyMap) -> VoxelGrid:
    return unpack(occupancy.to_binary(), occupancy.resolution_m, LOW, HIGH)


@pytest.fixture(scope="module")
def door() -> OccupancyMap:
    return seen(DOOR, [(8.0, y) for y in (-16.0, -10.0, -4.0, 2.0, 8.0, 14.0)] + [(20.0, -4.0)])


def test_the_map_has_the_wall_and_the_door(door: OccupancyMap) -> None:
    # The wall's face from y = -16 to 14 at the height of the camera, and the opening.
    wall = np.array([[14.25, y, 3.25] for y in np.arange(-15.75, 14.0, 0.5) if not -8.0 <= y <= 0.0])
    opening = np.array([[x, y, 3.25] for x in (13.25, 14.25, 15.25) for y in np.arange(-6.75, -1.0, 0.5)])
    assert door.occupied(wall).mean() > 0.95
    assert not door.occupied(opening).any()
    assert (door.labels(opening) == 0).all()


@every_planner
def test_the_way_leads_through_the_door(door: OccupancyMap, planner: str) -> None:
    grid = grid_of(door)
    for seed in (1, 2, 3):
        path = plan(planner, grid, START, GOAL, seed)
        assert path is not None
        crossing = [a + (b - a) * (14.5 - a[0]) / (b[0] - a[0])
                    for a, b in itertools.pairwise(path) if a[0] < 14.5 <= b[0]]  # fmt: skip
        assert crossing
        for point in crossing:
            assert -8.0 < point[1] < 0.0
        rows = trajectory(path, Departure(0.0, START, np.zeros(3), np.zeros(3), 0.0), grid)
        assert rows is not None
        assert all(grid.edge_clear(a[1:4], b[1:4], CLOSE) for a, b in itertools.pairwise(rows))
        assert time_to_collision(rows, 0.0, door) == math.inf


def test_the_straight_way_hits_the_wall_beside_the_door(door: OccupancyMap) -> None:
    rows = trajectory(
        np.array([[0.0, 6.0, 3.0], [30.0, 6.0, 3.0]]),
        Departure(0.0, np.array([0.0, 6.0, 3.0]), np.zeros(3), np.zeros(3), 0.0),
        open_space(),
    )
    assert rows is not None
    struck_s = time_to_collision(rows, 0.0, door)
    assert state_at(rows, struck_s)[0] == pytest.approx(14.0 - 1.5, abs=0.75)


@every_planner
def test_there_is_no_way_out_of_a_closed_box(planner: str) -> None:
    grid = grid_of(seen(CLOSED_BOX, [(0.0, 0.0)]))
    assert plan(planner, grid, START, GOAL, 1) is None


@every_planner
def test_through_a_free_field_the_way_is_straight(planner: str) -> None:
    grid = grid_of(seen(FREE_FIELD, [(0.0, 0.0), (8.0, 0.0)]))
    assert (grid.levels[..., 2:] == FREE).all()
    path = plan(planner, grid, START, GOAL, 1)
    assert path is not None
    assert length(path) == pytest.approx(30.0, rel=0.01)


def length(path: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def cost(path: NDArray[np.float64] | None) -> float:
    """What the planners minimise; infinite without a path."""
    return math.inf if path is None else length(path * [1.0, 1.0, CLIMB_WEIGHT])


def test_on_the_median_of_50_seeds_no_path_costs_less_than_that_of_rrt_star() -> None:
    scenes = [(walled(), START, GOAL)]
    sample = KERNELS["rrt_star"].sample()
    grid, departure = problem(sample)
    scenes.append((grid, departure.position, sample["goal"]))
    for scene, start, goal in scenes:
        medians = {
            planner: np.median([cost(plan(planner, scene, start, goal, seed)) for seed in range(1, 51)])
            for planner in ("rrt", "rrt_connect", "rrt_star")
        }
        assert math.isfinite(medians["rrt_star"])
        assert medians["rrt_star"] <= medians["rrt"] + 1e-9, medians
        assert medians["rrt_star"] <= medians["rrt_connect"] + 1e-9, medians


def coordinates(
    low: NDArray[np.float64], high: NDArray[np.float64]
) -> st.SearchStrategy[NDArray[np.float64]]:
    axes = [st.floats(float(a) + 1.0, float(b) - 1.0) for a, b in zip(low, high, strict=True)]
    return st.tuples(*axes).map(np.array)


@given(
    st.lists(coordinates(LOW, HIGH), min_size=2, max_size=5),
    st.tuples(*[st.floats(-1.7, 1.7)] * 3).map(np.array),
    st.floats(-3.1, 3.1),
    st.sampled_from([(SPEED_LIMIT_M_S, ACCELERATION_LIMIT_M_S2), (1.0, 2.0)]),
    st.booleans(),
)
def test_no_trajectory_exceeds_the_limits(
    corners: list[NDArray[np.float64]],
    velocity: NDArray[np.float64],
    yaw: float,
    limits: tuple[float, float],
    among_walls: bool,
) -> None:
    path = np.array(corners)
    velocity = velocity * (limits[0] / SPEED_LIMIT_M_S)  # no faster than a trajectory within the limits
    departure = Departure(10.0, path[0], velocity, np.zeros(3), yaw)
    rows = trajectory(path, departure, walled() if among_walls else open_space(), OCCUPIED, *limits)
    if rows is None:
        return
    between = np.array([state_at(rows, t) for t in np.linspace(rows[0, 0], rows[-1, 0], 400)[:-1]])
    speeds = np.linalg.norm(np.vstack((rows[:, 4:7], between[:, 3:6])), axis=1)
    accelerations = np.linalg.norm(rows[:, 7:10], axis=1)
    assert speeds.max() <= limits[0] + ROUNDING
    assert accelerations.max() <= limits[1] + ROUNDING
    assert np.isfinite(rows).all()
    assert (np.diff(rows[:, 0]) > 0.0).all()


@given(st.sampled_from(PLANNERS), st.integers(1, 2**31 - 1), coordinates(LOW, HIGH))
def test_the_same_seed_gives_the_same_plan(planner: str, seed: int, goal: NDArray[np.float64]) -> None:
    grid = walled()
    departure = Departure(0.0, START, np.zeros(3), np.zeros(3), 0.0)
    plans = []
    for _ in range(2):
        path = plan(planner, grid, START, goal, seed, iterations=100)
        plans.append(None if path is None else trajectory(path, departure, grid))
    if plans[0] is None or plans[1] is None:
        assert plans[0] is plans[1] is None
    else:
        assert np.array_equal(plans[0], plans[1])
