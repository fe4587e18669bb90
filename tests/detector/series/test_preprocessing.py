"""Sign and exponent bits as an integer."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.series.preprocessing import FLOORS, levels

X, TTC = "trajectory.x", "collision_check.time_to_collision"


def level(value: float, state: str = X, form: str = "folded") -> float:
    return float(levels(state, np.array([value]), form)[0])


@pytest.mark.parametrize(
    ("value", "expected"), [(0.0, 0), (0.99, 0), (1e-300, 0), (1.0, 1), (1.99, 1), (2.0, 2), (30.0, 5)]
)
def test_powers_of_two_above_the_floor_are_counted(value: float, expected: int) -> None:
    assert FLOORS[X] == 0
    assert level(value) == expected
    assert level(-value) == -expected


@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(0, 51))
def test_the_mantissa_does_not_matter(value: float, bit: int) -> None:
    flipped = (np.array([value]).view(np.uint64) ^ np.uint64(1 << bit)).view(np.float64)[0]
    assert level(float(flipped)) == level(value)


@given(st.floats(-50.0, 50.0), st.floats(-1.0, 1.0))
def test_a_step_that_the_floor_allows_changes_the_level_by_two_at_most(value: float, step: float) -> None:
    assert abs(level(value + step) - level(value)) <= 2


def test_zero_is_passed_through_in_a_small_step_unlike_in_the_naive_form() -> None:
    assert level(-0.1) == level(1e-17) == level(0.1)
    assert abs(level(0.1, form="naive") - level(1e-17, form="naive")) > 50
    assert abs(level(0.1, form="naive") - level(-0.1, form="naive")) == 2048


def test_what_is_not_finite_is_far_from_every_number_but_no_collision_is_none() -> None:
    assert level(math.nan) > 1000
    assert level(-math.inf) < -1000
    assert level(math.inf, TTC) == 0
    assert level(-math.inf, TTC) < -1000
    assert level(2.0**1000, TTC) > 1000
