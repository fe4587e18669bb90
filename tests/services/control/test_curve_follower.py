"""Control flies the newest trajectory it may fly, and stops otherwise."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.control.curve_follower import CurveFollower, past
from services.control.follower import WAYPOINT_FIELDS, Follower, waypoints
from services.control.pid import state_at
from services.models.pilots import ALL_GUARDS, PILOTS
from services.models.safety import BRAKE_BELOW_S

HERE = np.array([0.0, 0.0, 3.0])
FAST = np.array([3.0, 0.0, 0.0])
NONE = np.empty((0, 12))


def eastwards(start_s: float = 0.0) -> NDArray[np.float64]:
    """60 m along x at 3 m/s."""
    rows = np.zeros((81, 12))
    t = np.arange(81) * 0.25
    rows[:, 0] = start_s + t
    rows[:, 1] = 3.0 * t
    rows[:, 3] = 3.0
    rows[:, 4] = 3.0
    return rows


def forward_speed(follower: Follower, now_s: float, x: float, speed: float = 3.0) -> float:
    position, velocity = np.array([x, 0.0, 3.0]), np.array([speed, 0.0, 0.0])
    return float(follower.command(now_s, position, velocity, 0.0, 0.04)[0])


@pytest.fixture
def flying() -> Follower:
    follower = CurveFollower(PILOTS["guarded"], ALL_GUARDS)
    assert follower.take_trajectory(1, 0, eastwards())
    assert forward_speed(follower, 1.0, 3.0) == pytest.approx(3.0)
    return follower


def test_without_a_trajectory_it_stops_and_hovers() -> None:
    follower = CurveFollower(PILOTS["guarded"], ALL_GUARDS)
    assert forward_speed(follower, 5.0, 10.0) == pytest.approx(3.0)
    assert forward_speed(follower, 5.5, 11.0, 1.0) < 1.5
    # Rest is a second and a bit later and about a metre farther on.
    assert forward_speed(follower, 9.0, 10.0 + 9.0 / 8.0, 0.0) == pytest.approx(0.0, abs=0.01)
    assert forward_speed(follower, 9.0, 12.0, 0.0) < 0.0


def test_a_new_trajectory_replaces_the_old_one_from_its_first_moment_on(flying: Follower) -> None:
    other = eastwards(2.0)
    other[:, 1] = 6.0
    other[:, 4] = 0.0
    assert flying.take_trajectory(2, 0, other)
    assert forward_speed(flying, 1.9, 5.7) == pytest.approx(3.0)
    assert forward_speed(flying, 2.1, 6.0, 0.0) == pytest.approx(0.0)


def test_a_trajectory_older_than_the_newest_collision_is_refused(flying: Follower) -> None:
    flying.take_verdict(1.0, 1, 2, 10.0)
    assert not flying.take_trajectory(2, 1, NONE)
    assert flying.take_trajectory(3, 2, eastwards())


def test_a_trajectory_older_than_the_one_that_was_checked_is_refused(flying: Follower) -> None:
    flying.take_verdict(1.0, 4, 0, math.inf)
    assert not flying.take_trajectory(3, 0, eastwards())
    assert flying.take_trajectory(4, 0, eastwards())
    # One absurd verdict does not last.
    flying.take_verdict(1.3, 2**32 - 1, 0, math.inf)
    assert not flying.take_trajectory(5, 0, eastwards())
    flying.take_verdict(1.6, 4, 0, math.inf)
    assert flying.take_trajectory(5, 0, eastwards())


def test_it_brakes_for_a_near_collision_and_waits_for_an_answer(flying: Follower) -> None:
    flying.take_verdict(1.0, 1, 1, 1.0)
    assert forward_speed(flying, 1.7, 5.1) > 2.5
    assert forward_speed(flying, 2.2, 6.2, 1.0) < 1.5
    # The verdict is taken back, but by now the trajectory is ahead of the vehicle.
    flying.take_verdict(2.3, 1, 1, math.inf)
    assert forward_speed(flying, 4.0, 6.2, 0.0) == pytest.approx(0.0, abs=0.3)
    assert flying.take_trajectory(2, 1, eastwards(2.0))
    assert forward_speed(flying, 4.1, 6.3, 3.0) == pytest.approx(3.0, abs=0.01)


def test_a_far_collision_is_braked_for_only_when_it_has_come_near(flying: Follower) -> None:
    flying.take_verdict(1.0, 1, 1, BRAKE_BELOW_S + 1.0)
    assert forward_speed(flying, 1.5, 4.5) == pytest.approx(3.0)
    forward_speed(flying, 2.1, 6.3)
    assert forward_speed(flying, 2.6, 7.5) < 2.0


def test_a_collision_of_another_trajectory_does_not_matter(flying: Follower) -> None:
    flying.take_verdict(1.0, 7, 0, 0.1)
    for t in (1.5, 2.0, 2.5):
        assert forward_speed(flying, t, 3.0 * t) == pytest.approx(3.0)


def test_an_empty_trajectory_stops_the_vehicle(flying: Follower) -> None:
    assert flying.take_trajectory(2, 0, NONE)
    forward_speed(flying, 2.0, 6.0)
    assert forward_speed(flying, 2.5, 7.0, 1.0) < 1.5


def test_restarted_in_flight_it_goes_on_with_the_newest_trajectory() -> None:
    follower = CurveFollower(PILOTS["guarded"], ALL_GUARDS)
    forward_speed(follower, 6.0, 18.0)
    follower.take_verdict(5.9, 4, 3, math.inf)
    follower.take_trajectory(4, 3, eastwards())
    assert forward_speed(follower, 6.1, 18.3) == pytest.approx(3.0)


def test_the_tracked_waypoint_is_the_next_row_with_the_row_behind_it() -> None:
    rows = np.zeros((3, 12))
    rows[:, 0] = (1.0, 1.25, 1.75)
    rows[:, 1] = (10.0, 11.0, 12.0)
    for now_s, behind, ahead, duration in (
        (0.5, 10.0, 10.0, 0.25),
        (1.0, 10.0, 11.0, 0.25),
        (1.25, 11.0, 12.0, 0.5),
        (9.0, 11.0, 12.0, 0.5),
    ):
        found = waypoints(rows, now_s)
        assert found.shape == (2, WAYPOINT_FIELDS)
        assert (found[0, 1], found[1, 1], found[1, 0]) == (behind, ahead, duration)
    np.testing.assert_array_equal(waypoints(rows[:1], 2.0)[:, 1], (10.0, 10.0))


def test_a_skipped_waypoint_is_not_flown_to(flying: Follower) -> None:
    bad = eastwards()
    bad[5, 2] = 40.0  # far to the left, a quarter of a second ahead
    assert flying.take_trajectory(2, 0, bad)
    position, velocity = np.array([3.3, 0.0, 3.0]), np.array([3.0, 0.0, 0.0])
    before = flying.state.copy()
    aside = flying.command(1.1, position, velocity, 0.0, 0.04)
    assert flying.skip_waypoint(1.1)
    assert np.array_equal(flying.state, before)
    ahead = flying.command(1.1, position, velocity, 0.0, 0.04)
    assert abs(aside[1]) > 1.0
    assert ahead == pytest.approx([3.0, 0.0, 0.0, 0.0], abs=0.05)


def test_the_way_past_a_waypoint_is_the_one_without_it() -> None:
    rows = eastwards()
    rows[:, 3] = 3.0 + 0.1 * rows[:, 0] ** 2
    rows[:, 6] = 0.2 * rows[:, 0]
    rows[4:, 10] = 0.5
    bridged, bare = past(rows, 5), np.delete(rows, 5, axis=0)
    assert bridged[:, 0].tolist() == rows[:, 0].tolist()
    for now_s in np.linspace(rows[4, 0], rows[6, 0], 21, endpoint=False):
        np.testing.assert_allclose(state_at(bridged, now_s), state_at(bare, now_s), atol=1e-9)


def test_of_neighbouring_waypoints_one_is_dropped(flying: Follower) -> None:
    bad = eastwards()
    bad[4, 2] = 40.0  # the row behind
    assert flying.take_trajectory(2, 0, bad)
    flying.command(1.1, np.array([3.3, 0.0, 3.0]), FAST, 0.0, 0.04)
    assert [flying.skip_waypoint(now_s) for now_s in (1.1, 1.14, 1.3, 1.6)] == [True, False, False, True]


def test_without_a_next_waypoint_it_stops(flying: Follower) -> None:
    assert not flying.skip_waypoint(19.9)
    forward_speed(flying, 19.9, 59.7)
    assert forward_speed(flying, 20.4, 60.5, 1.0) < 1.5
    assert not flying.skip_waypoint(20.4)


def test_skipping_changes_no_trajectory_but_the_one_that_is_flown(flying: Follower) -> None:
    newest = eastwards(2.0)
    assert flying.take_trajectory(2, 0, newest)
    assert flying.skip_waypoint(1.0)
    assert np.array_equal(newest, eastwards(2.0))
    forward_speed(flying, 2.5, 1.5)
    assert len(flying.curve(2.6, HERE, FAST, 0.0)) == len(newest)


def test_a_stop_does_not_go_on_against_the_wind_of_the_flight_before(flying: Follower) -> None:
    for tick in range(200):
        flying.command(1.0 + 0.04 * tick, np.array([3.0 + 0.12 * tick, -1.0, 3.0]), FAST, 0.0, 0.04)
    assert flying.take_trajectory(2, 0, NONE)
    place = np.array([27.0, -1.0, 3.0])
    assert flying.command(9.0, place, np.zeros(3), 0.0, 0.04) == pytest.approx(
        [0.0, 0.0, 0.0, 0.0], abs=0.001
    )
