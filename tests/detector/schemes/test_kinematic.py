"""The kinematic scheme."""

import math

import numpy as np
import pytest

from detector.schemes.kinematic import Kinematic
from tests.detector.flights import COLUMNS, flight, looked, planned, tracked

LESSONS = [Kinematic.lesson(flight(phase)) for phase in np.linspace(0.0, 6.0, 20)]
PARAMETERS = Kinematic.train(LESSONS, 0)


def test_error_free_flights_raise_no_alarm() -> None:
    detector = Kinematic.load(PARAMETERS)
    assert all(detector.check("perception", row[None]) is None for row in looked())
    assert detector.check("planning", planned(0.4)) is None
    assert detector.check("planning", np.empty((0, len(COLUMNS["planning"])))) is None
    assert detector.check("planning", planned(0.4, seq=2)) is None
    assert all(detector.check("control", tick) is None for tick in tracked(planned(0.4)))


@pytest.mark.parametrize(
    ("state", "by"),
    [("x", 0.02), ("y", -0.02), ("z", 0.02), ("vx", 0.1), ("vy", 0.1), ("ay", 1.0), ("t", 0.05)],
)
@pytest.mark.parametrize("row", [0, 40, 79])
def test_a_row_that_moves_by_centimetres_is_seen(state: str, by: float, row: int) -> None:
    points = planned()
    points[row, COLUMNS["planning"][f"trajectory.{state}"]] += by
    alarm = Kinematic.load(PARAMETERS).check("planning", points)
    assert alarm is not None
    assert abs(alarm.row - row) <= 1


def test_time_must_run_forward_and_nothing_be_nan() -> None:
    points = planned()
    points[5, 0] = points[4, 0]
    alarm = Kinematic.load(PARAMETERS).check("planning", points)
    assert alarm is not None
    assert alarm.score == math.inf
    for column in range(points.shape[1]):
        points = planned(seq=2)
        points[5, column] = math.nan
        detector = Kinematic.load(PARAMETERS)
        assert detector.check("planning", planned(seq=1)) is None
        # A sequence number stands in every row; the first is the one that is read.
        assert (detector.check("planning", points) is not None) == (column < 11)


def test_a_waypoint_must_follow_from_the_row_behind_it() -> None:
    tick = tracked(planned())[0]
    assert Kinematic.load(PARAMETERS).check("control", tick) is None
    tick[1, COLUMNS["control"]["trajectory.x"]] += 0.02
    assert Kinematic.load(PARAMETERS).check("control", tick) is not None


def test_sequence_numbers_do_not_run_back() -> None:
    detector = Kinematic.load(PARAMETERS)
    assert detector.check("planning", planned(seq=2)) is None
    alarm = detector.check("planning", planned(seq=1))
    assert alarm is not None
    assert alarm.state == "trajectory.trajectory_seq"


@pytest.mark.parametrize(
    ("row", "left_s", "collisions"),
    [
        (10, 1.0, 0.0),  # a collision that is not counted: infinity with its top exponent bit flipped
        (10, math.inf, 1.0),  # counted without a collision
        (30, math.inf, 0.0),  # counted back
        (21, 2.0**40, 1.0),  # farther than any trajectory reaches
        (21, -2.8, 1.0),
        (21, math.nan, 1.0),
    ],
)
def test_verdicts_that_contradict_themselves(row: int, left_s: float, collisions: float) -> None:
    detector = Kinematic.load(PARAMETERS)
    looks = looked()
    assert all(detector.check("perception", look[None]) is None for look in looks[:row])
    alarm = detector.check("perception", np.array([[left_s, collisions]]))
    assert alarm is not None
    assert detector.check("perception", looks[row][None]) is None
