"""The spline is the one of least snap."""

import numpy as np
import pytest

from services.planning.spline import excess, minimum_snap, sample

STILL = np.zeros(3)
POINTS = np.array([[0.0, 0, 3], [4, 1, 3], [7, -1, 4], [12, 0, 3]])
DURATIONS = np.array([3.0, 2.0, 4.0])


def test_from_rest_to_rest_it_is_the_known_polynomial() -> None:
    coefficients = minimum_snap(np.array([[0.0, 0, 0], [1, 2, -1]]), np.array([2.0]), STILL, STILL)
    for axis, distance in enumerate((1.0, 2.0, -1.0)):
        known = distance * np.array([0, 0, 0, 0, 35, -84, 70, -20])
        assert coefficients[0, :, axis] == pytest.approx(known, abs=1e-9)


def test_it_passes_the_waypoints_on_time_from_the_given_start_to_rest() -> None:
    velocity, acceleration = np.array([1.0, -0.5, 0.2]), np.array([0.3, 0.1, -0.1])
    coefficients = minimum_snap(POINTS, DURATIONS, velocity, acceleration)
    rows = sample(coefficients, DURATIONS, np.array([0.0, 3.0, 5.0, 9.0]))
    assert rows[:, :3] == pytest.approx(POINTS)
    assert rows[0, 3:] == pytest.approx([*velocity, *acceleration])
    assert rows[3, 3:] == pytest.approx(0.0, abs=1e-9)


def test_it_is_smooth_across_the_waypoints() -> None:
    coefficients = minimum_snap(POINTS, DURATIONS, STILL, STILL)
    for joint in range(2):
        for order in range(7):
            left = [
                np.polynomial.Polynomial(coefficients[joint, :, axis]).deriv(order)(1.0) for axis in range(3)
            ]
            right = [
                np.polynomial.Polynomial(coefficients[joint + 1, :, axis]).deriv(order)(0.0)
                for axis in range(3)
            ]
            scale = (DURATIONS[joint] / DURATIONS[joint + 1]) ** order
            assert left == pytest.approx(np.array(right) * scale, abs=1e-6)


def test_velocity_and_acceleration_are_the_derivatives_of_the_position() -> None:
    coefficients = minimum_snap(POINTS, DURATIONS, STILL, STILL)
    times = np.linspace(0.0, 9.0, 9001)
    rows = sample(coefficients, DURATIONS, times)
    assert np.gradient(rows[:, 0], times)[1:-1] == pytest.approx(rows[1:-1, 3], abs=1e-4)
    assert np.gradient(rows[:, 3], times)[1:-1] == pytest.approx(rows[1:-1, 6], abs=1e-3)


def test_a_long_spline_is_solved_exactly() -> None:
    draw = np.random.default_rng(3)
    points = np.cumsum(draw.uniform(-3.0, 3.0, (40, 3)), axis=0)
    durations = draw.uniform(0.3, 3.0, 39)
    rows = sample(minimum_snap(points, durations, STILL, STILL), durations, np.cumsum(durations))
    assert rows[:, :3] == pytest.approx(points[1:], abs=1e-5)


def test_a_segment_too_short_is_told_by_how_much() -> None:
    coefficients = minimum_snap(POINTS, DURATIONS, STILL, STILL)
    times = np.linspace(0.0, 9.0, 1000)
    motion = sample(coefficients, DURATIONS, times)
    fastest = np.linalg.norm(motion[times < 3.0, 3:6], axis=1).max()
    factors = excess(motion, times, DURATIONS, fastest / 1.5, 1e9)
    assert factors[0] == pytest.approx(1.5)
    assert (factors >= 1.0).all()
    assert excess(motion, times, DURATIONS, 1e9, 1e9) == pytest.approx(1.0)
