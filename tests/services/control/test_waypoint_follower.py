"""Waypoint after waypoint: each row is held for as long as it lasts, the wrong ones too."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.control.waypoint_follower import WaypointFollower
from services.models.pilots import PILOTS, Guards
from services.models.safety import BRAKE_BELOW_S, SPEED_LIMIT_M_S

BASELINE = PILOTS["baseline"]
TICK_S = 0.04


def eastwards(speed_m_s: float = 2.0, rows: int = 9) -> NDArray[np.float64]:
    """Rows 0.5 s apart, along x."""
    points = np.zeros((rows, 12))
    points[:, 0] = 0.5 * np.arange(rows)
    points[:, 1] = speed_m_s * points[:, 0]
    points[:-1, 4] = speed_m_s
    return points


def follower(points: NDArray[np.float64], guards: Guards = BASELINE.guards) -> WaypointFollower:
    flown = WaypointFollower(BASELINE, guards)
    assert flown.take_trajectory(1, 0, points)
    return flown


def fly(flown: WaypointFollower, seconds: float, start_s: float = 0.0) -> NDArray[np.float64]:
    """Where a vehicle is (n, 3) that does exactly what it is told."""
    position, places = np.zeros(3), []
    for tick in range(round(seconds / TICK_S)):
        command = flown.command(start_s + tick * TICK_S, position, np.zeros(3), 0.0, TICK_S)
        position = position + TICK_S * np.nan_to_num(command[:3])
        places.append(position)
    return np.array(places)


def test_rows_are_held_one_after_the_other_and_then_it_hovers() -> None:
    places = fly(follower(eastwards()), 6.0)
    assert places[-1, 0] == pytest.approx(8.0, abs=0.6)
    assert (places[-20:, 0] == places[-1, 0]).all()


def test_a_trajectory_begins_when_it_comes() -> None:
    points = eastwards()
    points[:, 0] += 100.0
    assert fly(follower(points), 6.0)[-1, 0] == pytest.approx(8.0, abs=0.6)


def test_the_command_is_velocity_and_proportional_term() -> None:
    flown = follower(eastwards())
    command = flown.command(0.0, np.array([-1.0, 0.0, -1.0]), np.zeros(3), 0.0, TICK_S)
    assert command[:3] == pytest.approx(
        [2.0 + BASELINE.proportional_level, 0.0, BASELINE.proportional_vertical]
    )


def test_what_is_too_fast_is_flown_slower_and_as_much_longer() -> None:
    """Twice the limit: half the speed for twice the time, so the same way."""
    points = eastwards(2.0 * SPEED_LIMIT_M_S, rows=2)
    points[:, 1] = 0.0
    flown = follower(points)
    speeds = [
        float(flown.command(t, np.zeros(3), np.zeros(3), 0.0, TICK_S)[0]) for t in np.arange(0.0, 2.0, TICK_S)
    ]
    assert sum(speeds) * TICK_S == pytest.approx(0.5 * 2.0 * SPEED_LIMIT_M_S, rel=0.1)
    assert max(speeds) == pytest.approx(SPEED_LIMIT_M_S)


@pytest.mark.parametrize("column", [1, 4], ids=["position", "velocity"])
def test_a_waypoint_at_the_end_of_the_world_is_flown_to_for_ever(column: int) -> None:
    points = eastwards()
    points[2, column] = 1e200
    places = fly(follower(points), 60.0)
    assert places[-1, 0] == pytest.approx(60.0 * SPEED_LIMIT_M_S, rel=0.05)


def test_with_its_guards_the_same_waypoint_is_one_of_many() -> None:
    points = eastwards()
    points[2, 1] = 1e200
    places = fly(follower(points, frozenset((*BASELINE.guards, "limits", "finite"))), 60.0)
    assert places[-1, 0] < 12.0


def test_a_row_that_never_ends_is_held() -> None:
    points = eastwards()
    points[3:, 0] = 1e9
    # Its velocity drives on, its position pulls back: to rest where the two are even.
    there = points[2, 1] + points[2, 4] / BASELINE.proportional_level
    assert fly(follower(points), 60.0)[-1, 0] == pytest.approx(there, rel=0.01)


def test_a_number_that_is_none_reaches_the_command_unless_it_is_refused() -> None:
    points = eastwards()
    points[0, 4] = math.nan
    hover = np.zeros(3), np.zeros(3), 0.0, TICK_S
    assert math.isnan(follower(points).command(0.0, *hover)[0])
    guarded = follower(points, frozenset((*BASELINE.guards, "finite")))
    assert np.isfinite(guarded.command(0.0, *hover)).all()
    assert guarded.acted["finite"] > 0


def test_it_stops_for_a_collision_that_is_counted_as_new_and_waits_for_a_plan_that_knows() -> None:
    flown = follower(eastwards())
    flown.take_verdict(0.0, 1, 0, 0.5)
    assert flown.command(0.1, np.zeros(3), np.zeros(3), 0.0, TICK_S)[0] > 1.0  # not counted: not believed
    flown.take_verdict(0.2, 1, 1, BRAKE_BELOW_S + 1.0)
    assert flown.command(0.3, np.zeros(3), np.zeros(3), 0.0, TICK_S)[0] > 1.0
    assert flown.command(1.3, np.zeros(3), np.zeros(3), 0.0, TICK_S)[0] == 0.0
    assert not flown.take_trajectory(2, 0, eastwards())
    assert flown.take_trajectory(2, 1, eastwards())
    assert flown.command(1.4, np.zeros(3), np.zeros(3), 0.0, TICK_S)[0] > 1.0


def test_with_the_guard_it_brakes_for_any_verdict() -> None:
    flown = follower(eastwards(), frozenset((*BASELINE.guards, "brake")))
    flown.take_verdict(0.0, 1, 0, 0.5)
    assert flown.command(0.1, np.zeros(3), np.zeros(3), 0.0, TICK_S)[0] == 0.0
    assert flown.acted["brake"] == 1


def test_a_dropped_waypoint_makes_way_for_the_next() -> None:
    points = eastwards()
    points[0, 4] = 1e200
    flown = follower(points)
    hover = np.zeros(3), np.zeros(3), 0.0, TICK_S
    assert flown.command(0.0, *hover)[0] == pytest.approx(SPEED_LIMIT_M_S)
    assert flown.tracked(0.0)[1, 4] == 1e200
    assert flown.skip_waypoint(0.0)
    assert flown.command(0.0, *hover)[0] == pytest.approx(2.0 + BASELINE.proportional_level)
    assert flown.tracked(0.0)[1] == pytest.approx([0.5, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_after_the_last_waypoint_there_is_none_to_take() -> None:
    flown = follower(eastwards(rows=2))
    flown.command(0.0, np.zeros(3), np.zeros(3), 0.0, TICK_S)
    assert flown.skip_waypoint(0.0)
    assert not flown.skip_waypoint(0.0)
    assert flown.command(0.0, np.zeros(3), np.zeros(3), 0.0, TICK_S)[0] == 0.0
