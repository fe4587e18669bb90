"""The command follows the trajectory, keeps its limits and is always a number."""

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.control.pid import (
    REPORT_SIZE,
    STATE_SIZE,
    YAW_RATE_LIMIT_RAD_S,
    pid,
    state_at,
    stopping,
    tuning,
)
from services.models.pilots import ALL_GUARDS, PILOTS
from services.models.safety import SPEED_LIMIT_M_S

PERIOD_S = 0.04
STILL = np.zeros(3)
REPORT = np.zeros(REPORT_SIZE)
GUARDED = tuning(PILOTS["guarded"], ALL_GUARDS)


def motion(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows of a curve that is known exactly: a circle of 2 m at 1 rad/s, climbing at 0.5 m/s."""
    rows = np.zeros((len(t), 12))
    rows[:, 0] = t
    rows[:, 1:4] = np.column_stack([2 * np.cos(t), 2 * np.sin(t), 0.5 * t])
    rows[:, 4:7] = np.column_stack([-2 * np.sin(t), 2 * np.cos(t), np.full(len(t), 0.5)])
    rows[:, 7:10] = np.column_stack([-2 * np.cos(t), -2 * np.sin(t), np.zeros(len(t))])
    rows[:, 10] = np.remainder(t + math.pi / 2 + math.pi, math.tau) - math.pi
    return rows


def hover(x: float, y: float, z: float, yaw: float = 0.0) -> NDArray[np.float64]:
    rows = np.zeros((2, 12))
    rows[:, 0] = (0.0, 1.0)
    rows[:, 1:4] = (x, y, z)
    rows[:, 10] = yaw
    return rows


def command(
    trajectory: NDArray[np.float64],
    now_s: float = 0.5,
    position: NDArray[np.float64] = STILL,
    velocity: NDArray[np.float64] = STILL,
    yaw: float = 0.0,
) -> NDArray[np.float64]:
    return pid(trajectory, now_s, position, velocity, yaw, PERIOD_S, np.zeros(STATE_SIZE), GUARDED, REPORT)


def test_between_its_points_the_trajectory_is_the_curve_they_were_taken_from() -> None:
    rows = motion(np.arange(0.0, 10.0, 0.25))
    for t in np.linspace(0.01, 9.7, 97):
        exact = motion(np.array([t]))[0]
        state = state_at(rows, t)
        assert state[:6] == pytest.approx(exact[1:7], abs=1e-4)
        assert state[6:9] == pytest.approx(exact[7:10], abs=1e-2)
        assert math.remainder(state[9] - exact[10], math.tau) == pytest.approx(0.0, abs=1e-9)
        assert state[10] == pytest.approx(1.0)


def test_before_and_after_its_time_a_trajectory_is_a_place_to_hover() -> None:
    rows = motion(np.arange(1.0, 3.0, 0.25))
    assert state_at(rows, 0.0)[:6] == pytest.approx([*rows[0, 1:4], 0, 0, 0])
    assert state_at(rows, 9.0)[:6] == pytest.approx([*rows[-1, 1:4], 0, 0, 0])


def test_a_vehicle_that_lags_follows_the_curve() -> None:
    rows = motion(np.arange(0.0, 20.0, 0.25))
    position, velocity, yaw = rows[0, 1:4].copy(), rows[0, 4:7].copy(), rows[0, 10]
    state = np.zeros(STATE_SIZE)
    errors = []
    for tick in range(450):
        now = tick * PERIOD_S
        out = pid(rows, now, position, velocity, yaw, PERIOD_S, state, GUARDED, REPORT)
        velocity += (out[:3] - velocity) * PERIOD_S / 0.3
        position += velocity * PERIOD_S
        yaw += out[3] * PERIOD_S
        errors.append(np.linalg.norm(position - state_at(rows, now + PERIOD_S)[:3]))
    assert max(errors[100:]) < 0.5
    assert math.remainder(yaw - state_at(rows, 450 * PERIOD_S)[9], math.tau) == pytest.approx(0.0, abs=0.1)


def test_a_steady_wind_is_integrated_away() -> None:
    position, state = np.zeros(3), np.zeros(STATE_SIZE)
    for _ in range(2000):
        out = pid(hover(0, 0, 0), 0.5, position, STILL, 0.0, PERIOD_S, state, GUARDED, REPORT)
        position += (out[:3] + np.array([0.15, 0.0, 0.0])) * PERIOD_S
    assert np.linalg.norm(position) < 0.02


@pytest.mark.parametrize("goal", [(50.0, 0.0, 0.0), (-40.0, 30.0, 0.0), (9.0, 9.0, 50.0), (0.0, 0.0, -50.0)])
def test_speed_is_limited_level_and_vertically(goal: tuple[float, float, float]) -> None:
    out = command(hover(*goal))
    assert math.hypot(out[0], out[1]) <= SPEED_LIMIT_M_S + 1e-9
    assert abs(out[2]) <= SPEED_LIMIT_M_S
    assert np.linalg.norm(out[:3]) == pytest.approx(
        np.linalg.norm([SPEED_LIMIT_M_S * (goal[0] != 0.0), SPEED_LIMIT_M_S * (goal[2] != 0.0)])
    )
    assert np.dot(out[:2], goal[:2]) >= 0.0


@pytest.mark.parametrize(
    ("yaw", "wanted", "sign"), [(0.0, 1.0, 1), (3.0, -3.0, 1), (-3.0, 3.0, -1), (0.0, 0.001, 0)]
)
def test_it_turns_the_short_way_and_not_for_a_trifle(yaw: float, wanted: float, sign: int) -> None:
    assert np.sign(command(hover(0, 0, 0, wanted), yaw=yaw)[3]) == sign


def test_yaw_rate_is_limited() -> None:
    assert command(hover(0, 0, 0, 3.0))[3] == pytest.approx(YAW_RATE_LIMIT_RAD_S)


@pytest.mark.parametrize("nonsense", [math.nan, math.inf, -math.inf, 1e308, -1e308])
def test_no_nonsense_reaches_the_command(nonsense: float) -> None:
    state = np.zeros(STATE_SIZE)
    for row, column in itertools.product(range(4), range(12)):
        rows = motion(np.arange(0.0, 1.0, 0.25))
        rows[row, column] = nonsense
        for now in (0.3, 0.6):
            out = pid(rows, now, STILL, STILL, 0.0, PERIOD_S, state, GUARDED, REPORT)
            assert np.isfinite(out).all()
            assert np.isfinite(state).all()
            assert math.hypot(out[0], out[1]) <= SPEED_LIMIT_M_S + 1e-9
            assert abs(out[2]) <= SPEED_LIMIT_M_S
            assert abs(out[3]) <= YAW_RATE_LIMIT_RAD_S
    bad = np.full(3, nonsense)
    assert np.isfinite(command(hover(1, 1, 1), position=bad, velocity=bad, yaw=nonsense)).all()
    assert np.isfinite(command(hover(1, 1, 1), now_s=nonsense)).all()


def test_a_poisoned_integral_recovers() -> None:
    state = np.full(STATE_SIZE, math.nan)
    assert np.isfinite(pid(hover(0, 0, 0), 0.5, STILL, STILL, 0.0, PERIOD_S, state, GUARDED, REPORT)).all()
    assert np.isfinite(state).all()


@pytest.mark.parametrize("nonsense", [math.nan, math.inf])
def test_what_has_no_gain_keeps_no_nonsense(nonsense: float) -> None:
    """A proportional controller without guards forgets a wrong position with the next right one."""
    pilot = PILOTS["baseline"]
    state, alone = np.zeros(STATE_SIZE), tuning(pilot, pilot.guards)
    bad = np.full(3, nonsense)
    pid(hover(1, 1, 1), 0.5, bad, bad, 0.0, PERIOD_S, state, alone, REPORT)
    for velocity in (STILL, bad):
        out = pid(hover(1, 1, 1), 0.54, STILL, velocity, 0.0, PERIOD_S, state, alone, REPORT)
        assert out[:3] == pytest.approx([0.2, 0.2, 0.5])


def test_stopping_is_straight_on_and_comes_to_rest() -> None:
    velocity = np.array([2.4, -1.8, 0.0])
    rows = stopping(10.0, np.array([1.0, 2.0, 3.0]), velocity, 0.7, 4.0)
    assert rows[-1, 0] == pytest.approx(10.75)
    assert rows[-1, 1:4] == pytest.approx(np.array([1.0, 2.0, 3.0]) + 0.375 * velocity)
    assert state_at(rows, 10.375)[3:6] == pytest.approx(velocity / 2)
    assert state_at(rows, 99.0)[3:6] == pytest.approx(0.0)
    assert state_at(stopping(10.0, STILL, STILL, 0.7, 4.0), 11.0)[:10] == pytest.approx([0.0] * 9 + [0.7])


def test_a_vehicle_that_faces_aside_has_turned_within_a_second_and_a_quarter() -> None:
    yaw, yaws = 0.0, []
    for tick in range(32):
        yaw += (
            pid(
                hover(0, 0, 0, 0.5),
                tick * PERIOD_S,
                STILL,
                STILL,
                yaw,
                PERIOD_S,
                np.zeros(STATE_SIZE),
                GUARDED,
                REPORT,
            )[3]
            * PERIOD_S
        )
        yaws.append(yaw)
    assert max(yaws) <= 0.5
    assert yaws[-1] == pytest.approx(0.5, abs=0.05)


def test_no_turn_is_faster_than_ninety_degrees_a_second() -> None:
    assert math.degrees(command(hover(0, 0, 0, 3.0))[3]) == pytest.approx(90.0)


def test_a_vehicle_a_metre_aside_is_back_within_three_seconds() -> None:
    """With a lag of 0.3 s in its velocity: soon, and without swinging far beyond."""
    position, velocity, state = np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(STATE_SIZE)
    places = []
    for tick in range(75):
        out = pid(hover(0, 0, 0), tick * PERIOD_S, position, velocity, 0.0, PERIOD_S, state, GUARDED, REPORT)
        velocity += (out[:3] - velocity) * PERIOD_S / 0.3
        position += velocity * PERIOD_S
        places.append(position[0])
    assert min(places) > -0.15
    assert abs(places[-1]) < 0.12
    assert next(tick for tick, place in enumerate(places) if place < 0.5) * PERIOD_S < 0.8


def test_a_speed_that_the_trajectory_does_not_have_is_braked() -> None:
    there = hover(0.0, 0.0, 0.0)
    assert command(there, velocity=np.array([1.0, 0.0, 0.0]))[:3] == pytest.approx([-0.15, 0.0, 0.0])


def test_what_a_minute_far_away_leaves_in_the_integral_is_soon_flown_off() -> None:
    there, state = hover(5.0, 0.0, 0.0), np.zeros(STATE_SIZE)
    for _ in range(1500):
        pid(there, 0.5, STILL, STILL, 0.0, PERIOD_S, state, GUARDED, REPORT)
    assert (
        abs(pid(there, 0.5, np.array([5.0, 0.0, 0.0]), STILL, 0.0, PERIOD_S, state, GUARDED, REPORT)[0])
        <= 0.2
    )
