"""What the backup controller commands is bounded and leads to the waypoint, whatever it is given."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.control.simple_controller import GAIN_1_S, simple_command

ANY = st.tuples(*[st.floats()] * 3)
SPEED_M_S = 3.0


@given(ANY, ANY)
def test_no_command_is_faster_than_the_limit_or_no_number(
    position: tuple[float, ...], waypoint: tuple[float, ...]
) -> None:
    command = simple_command(np.array(position), np.array(waypoint), SPEED_M_S)
    assert command.shape == (4,)
    assert np.isfinite(command).all()
    assert np.linalg.norm(command[:3]) <= SPEED_M_S * (1 + 1e-12)
    assert command[3] == 0.0


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_a_waypoint_that_makes_no_sense_is_a_hover(wrong: float) -> None:
    assert simple_command(np.zeros(3), np.array([1.0, wrong, 0.0]), SPEED_M_S).tolist() == [0.0] * 4


@pytest.mark.parametrize("begin", [(0.0, 0.0, 2.0), (30.0, -20.0, 9.0), (4.9, 5.1, 1.9)])
def test_it_leads_to_the_waypoint_and_not_beyond(begin: tuple[float, ...]) -> None:
    here, there = np.array(begin), np.array([5.0, 5.0, 2.0])
    apart = [float(np.linalg.norm(there - here))]
    for _ in range(1000):
        here = here + 0.04 * simple_command(here, there, SPEED_M_S)[:3]
        apart.append(float(np.linalg.norm(there - here)))
    assert all(after <= before for before, after in itertools.pairwise(apart))
    assert apart[-1] < 1e-3


def test_near_by_the_speed_is_in_proportion() -> None:
    command = simple_command(np.zeros(3), np.array([0.0, 0.5, 0.0]), SPEED_M_S)
    assert command.tolist() == [0.0, 0.5 * GAIN_1_S, 0.0, 0.0]
