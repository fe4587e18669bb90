"""The Gaussian scheme."""

import math

import numpy as np
import pytest

from detector.schemes.gaussian import MONITORED, Gaussian, welford
from tests.detector.flights import COLUMNS, flight, looked, planned, tracked

LESSONS = [Gaussian.lesson(flight(phase)) for phase in np.linspace(0.0, 6.0, 20)]
PARAMETERS = Gaussian.train(LESSONS, 0)


def test_the_recurrences_are_mean_and_deviation() -> None:
    samples = np.random.default_rng(1).normal(3.0, 2.0, 1000)
    count, mean, squares = welford(0, 0.0, 0.0, samples)
    assert count == 1000
    assert math.isclose(mean, samples.mean())
    assert math.isclose(math.sqrt(squares / (count - 1)), samples.std(ddof=1))


def test_error_free_flights_raise_no_alarm() -> None:
    detector = Gaussian.load(PARAMETERS)
    assert all(detector.check("perception", row[None]) is None for row in looked())
    assert detector.check("planning", planned(0.4)) is None
    assert detector.check("planning", planned(0.4, seq=2)) is None
    assert all(detector.check("control", tick) is None for tick in tracked(planned(0.4)))


@pytest.mark.parametrize(("state", "row"), [("trajectory.y", 30), ("trajectory.vx", 0), ("trajectory.t", 79)])
def test_a_point_that_jumps_is_named(state: str, row: int) -> None:
    points = planned()
    points[row, COLUMNS["planning"][state]] *= 2.0**30
    detector = Gaussian.load(PARAMETERS)
    alarm = detector.check("planning", points)
    assert alarm is not None
    assert (alarm.stage, alarm.state) == ("planning", state)
    assert alarm.row in (row, row + 1)
    assert alarm.score > 1.0
    assert math.isclose(detector.score("planning", points), alarm.score)


def test_a_command_that_jumps_is_named_unless_another_curve_was_taken_up() -> None:
    ticks = tracked(planned())
    detector = Gaussian.load(PARAMETERS)
    assert detector.check("control", ticks[0]) is None
    jumped = ticks[1].copy()
    jumped[:, COLUMNS["control"]["command.vx"]] *= -1.0
    alarm = detector.check("control", jumped)
    assert alarm is not None
    assert alarm.state == "command.vx"
    jumped[:, COLUMNS["control"]["curve"]] += 1.0
    assert detector.check("control", jumped) is None


def test_after_an_alarm_the_predecessor_is_what_passed_last_until_reset() -> None:
    ticks = tracked(planned())
    jumped = ticks[1].copy()
    jumped[:, COLUMNS["control"]["command.vx"]] *= -1.0
    detector = Gaussian.load(PARAMETERS)
    assert detector.check("control", ticks[0]) is None
    assert detector.check("control", jumped) is not None
    assert detector.check("control", ticks[2]) is None
    assert detector.check("control", jumped) is not None
    detector.reset("control")
    assert detector.check("control", jumped) is None


def test_what_passes_is_learned_and_what_is_alarmed_is_not() -> None:
    detector = Gaussian.load(PARAMETERS)
    before = detector.learned("trajectory.y")
    assert detector.check("planning", planned()) is None
    after = detector.learned("trajectory.y")
    assert after[0] == before[0] + 79
    assert after[1:] != before[1:]
    bad = planned()
    bad[10, COLUMNS["planning"]["trajectory.z"]] = math.nan
    assert detector.check("planning", bad) is not None
    assert detector.learned("trajectory.y") == after
    silent = Gaussian.load(PARAMETERS, learning=False)
    assert silent.check("planning", planned()) is None
    assert silent.learned("trajectory.y") == before


def test_the_number_of_deviations_is_set_state_by_state() -> None:
    bold = {**PARAMETERS, "states": {**PARAMETERS["states"]}}
    bold["states"]["trajectory.x"] = {**bold["states"]["trajectory.x"], "sigmas": 0.5}
    alarm = Gaussian.load(bold).check("planning", planned())
    assert alarm is not None
    assert alarm.state == "trajectory.x"


def test_no_way_is_a_check_like_any_other() -> None:
    detector = Gaussian.load(PARAMETERS)
    assert detector.check("planning", np.empty((0, len(COLUMNS["planning"])))) is None
    assert detector.check("planning", planned()) is None


def test_every_monitored_state_is_watched() -> None:
    assert all(set(names) <= set(COLUMNS[stage]) for stage, names in MONITORED.items())
