"""Trajectories can be flown: within the limits, clear, with the nose ahead."""

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.models.safety import SPEED_LIMIT_M_S
from services.planning.planners import plan
from services.planning.trajectory import (
    ACCELERATION_LIMIT_M_S2,
    STEP_S,
    YAW_RATE_LIMIT_RAD_S,
    Departure,
    trajectory,
)
from services.planning.voxels import CLOSE, OCCUPIED, VoxelGrid
from tests.services.planning.maps import GOAL, START, box, grid, open_space, wall_with_ends

STILL = np.zeros(3)
STRAIGHT = np.array([START, GOAL])
CORNERED = np.array([[0.0, 0, 3], [10, 0, 3], [10, 12, 4], [30, 12, 4]])


def standing(yaw: float = 0.0, position: NDArray[np.float64] = START) -> Departure:
    return Departure(100.0, position, STILL, STILL, yaw)


def made(path: NDArray[np.float64], departure: Departure, within: VoxelGrid) -> NDArray[np.float64]:
    rows = trajectory(path, departure, within)
    assert rows is not None
    return rows


@pytest.mark.parametrize("path", [STRAIGHT, CORNERED, STRAIGHT[:, [1, 0, 2]] + [0.0, -15.0, 0.0]])
def test_it_keeps_the_limits_and_ends_at_rest(path: NDArray[np.float64]) -> None:
    rows = made(path, standing(position=path[0]), open_space())
    assert rows[0, 1:4] == pytest.approx(path[0])
    assert rows[-1, 1:4] == pytest.approx(path[-1])
    assert rows[-1, 4:10] == pytest.approx(0.0, abs=1e-6)
    assert np.linalg.norm(rows[:, 4:7], axis=1).max() <= SPEED_LIMIT_M_S
    assert np.linalg.norm(rows[:, 7:10], axis=1).max() <= ACCELERATION_LIMIT_M_S2
    assert rows[0, 0] == 100.0
    steps = np.diff(rows[:, 0])
    assert (steps > 0.5 * STEP_S).all()
    assert (steps <= STEP_S + 1e-9).all()


def test_a_straight_way_is_flown_fast() -> None:
    rows = made(STRAIGHT, standing(), open_space())
    assert rows[-1, 0] - rows[0, 0] < 30.0 / SPEED_LIMIT_M_S + 4.0


def test_around_a_wall_the_safety_body_touches_nothing() -> None:
    walled = wall_with_ends()
    for seed in range(1, 6):
        path = plan("rrt_connect", walled, START, GOAL, seed)
        assert path is not None
        rows = made(path, standing(), walled)
        for a, b in itertools.pairwise(rows):
            assert walled.edge_clear(a[1:4], b[1:4], CLOSE)


def test_a_corner_that_would_be_cut_too_closely_is_not() -> None:
    """The spline through the corner's points would swing into the walls on either side."""
    walls = np.vstack(
        [box((-5.0, 3.0, 0.0), (9.0, 4.0, 11.0)), box((-5.0, -4.0, 0.0), (16.0, -3.0, 11.0)),
         box((8.0, 3.0, 0.0), (9.0, 20.0, 11.0)), box((15.0, -4.0, 0.0), (16.0, 20.0, 11.0))]
    )  # fmt: skip
    corridor = grid(walls, box((-8.0, -8.0, 0.0), (20.0, 20.0, 11.0)))
    path = np.array([[0.0, 0, 3], [12, 0, 3], [12, 15, 3]])
    rows = made(path, standing(), corridor)
    for a, b in itertools.pairwise(rows):
        assert corridor.edge_clear(a[1:4], b[1:4], CLOSE)


def test_in_flight_it_begins_with_the_present_motion() -> None:
    velocity, acceleration = np.array([2.0, 0.8, 0.0]), np.array([0.5, 0.0, 0.1])
    rows = made(STRAIGHT, Departure(100.0, START, velocity, acceleration, 0.3), open_space())
    assert rows[0, 4:10] == pytest.approx([*velocity, *acceleration])
    assert not rows[:, 11].any()


def test_what_cannot_be_turned_away_from_in_time_gives_no_trajectory() -> None:
    backwards = Departure(100.0, START, np.array([-3.0, 0.0, 0.0]), STILL, math.pi)
    made(STRAIGHT, backwards, open_space())
    walled = grid(box((-3.5, -6.0, 0.0), (-3.0, 6.0, 11.0)), box((-3.0, -8.0, 0.0), (9.0, 8.0, 11.0)))
    assert trajectory(STRAIGHT, backwards, walled) is None


def test_the_nose_points_where_the_vehicle_goes() -> None:
    rows = made(CORNERED, standing(), open_space())
    moving = rows[np.linalg.norm(rows[:, 4:6], axis=1) > 1.0]
    off = np.abs(
        np.remainder(moving[:, 10] - np.arctan2(moving[:, 5], moving[:, 4]) + math.pi, math.tau) - math.pi
    )
    assert off.max() < math.radians(45.0)  # half the camera's field of view


def test_it_turns_on_the_spot_before_it_departs() -> None:
    rows = made(STRAIGHT, standing(yaw=3.0), open_space())
    turning = rows[rows[:, 11] == 1.0]
    assert turning[-1, 0] - turning[0, 0] > 3.0 / YAW_RATE_LIMIT_RAD_S - 2 * STEP_S
    assert turning[:, 1:4] == pytest.approx(np.broadcast_to(START, (len(turning), 3)))
    first = rows[len(turning)]
    assert abs(first[10]) < math.radians(20.0)
    assert first[4:7] == pytest.approx(0.0)
    assert not made(STRAIGHT, standing(yaw=0.3), open_space())[:, 11].any()


@pytest.mark.parametrize("yaw", [0.0, 3.0, -3.0])
def test_yaw_is_turned_within_its_rate(yaw: float) -> None:
    rows = made(CORNERED, standing(yaw=yaw), open_space())
    turns = np.abs(np.remainder(np.diff(rows[:, 10]) + math.pi, math.tau) - math.pi)
    assert (turns <= YAW_RATE_LIMIT_RAD_S * np.diff(rows[:, 0]) + 1e-9).all()
    assert (np.abs(rows[:, 10]) <= math.pi).all()


def test_a_start_too_close_to_a_wall_is_left() -> None:
    walled = wall_with_ends()
    start = np.array([13.0, 0.0, 3.0])
    path = plan("rrt_connect", walled, start, GOAL, 1)
    assert path is not None
    rows = made(path, standing(position=start), walled)
    assert all(walled.edge_clear(a[1:4], b[1:4], OCCUPIED) for a, b in itertools.pairwise(rows))


def test_a_way_of_no_length_is_a_place_to_hover() -> None:
    for path in (np.array([START]), np.array([START, START])):
        rows = made(path, standing(), open_space())
        assert rows[:, 1:4] == pytest.approx(np.broadcast_to(START, (len(rows), 3)))
        assert np.isfinite(rows).all()
