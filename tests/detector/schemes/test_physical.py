"""The physical scheme, on vehicles that answer their commands as a linear system in gusts."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from detector.schemes.physical import STATES, Physical
from detector.series.series import Checks, Series
from tests.detector.flights import COLUMNS, TICK_S

Floats = NDArray[np.float64]
CONTROL = COLUMNS["control"]
GUST_M_S = 0.002
"""What gusts change the velocity by in a tick, a deviation."""


def ticks(seed: int, count: int = 400, answer: float = 0.1, from_tick: int = 0) -> Floats:
    """(count, 2, columns): checks of a flight; the vehicle answers its commands by 0.1 a tick, or else."""
    draw = np.random.default_rng(seed)
    rows = np.zeros((count, 2, len(CONTROL)))
    position, velocity = np.zeros(3), np.zeros(3)
    for tick in range(count):
        command = 2.0 * np.sin(0.02 * tick + np.arange(3.0) + seed)
        rows[tick, :, CONTROL["odometry.x"] : CONTROL["odometry.x"] + 3] = position
        rows[tick, :, CONTROL["odometry.vx"] : CONTROL["odometry.vx"] + 3] = velocity
        rows[tick, :, CONTROL["command.vx"] : CONTROL["command.vx"] + 3] = command
        share = answer if tick >= from_tick else 0.1
        after = velocity + share * (command - velocity) + draw.normal(0.0, GUST_M_S, 3)
        position = position + 0.5 * TICK_S * (velocity + after) + draw.normal(0.0, 1e-4, 3)
        velocity = after
    return rows


def flight(seed: int) -> Series:
    rows = ticks(seed)
    count = len(rows)
    control = Checks(rows.reshape(2 * count, -1), 2 * np.arange(count), TICK_S * np.arange(float(count)))
    return Series({"control": control}, {})


PARAMETERS = Physical.train([Physical.lesson(flight(seed)) for seed in range(20)], 0)


def alarmed(rows: Floats) -> list[tuple[int, str, float]]:
    """Of which ticks there are alarms; after each the detector begins again."""
    detector, found = Physical.load(PARAMETERS), []
    for tick, values in enumerate(rows):
        alarm = detector.check("control", values)
        if alarm is not None:
            found.append((tick, alarm.state, alarm.score))
            detector.reset("control")
    return found


def test_error_free_flights_raise_no_alarm() -> None:
    assert [alarmed(ticks(seed)) for seed in range(100, 120)] == [[]] * 20


@pytest.mark.parametrize("state", STATES)
def test_a_jump_is_seen_at_once_and_named(state: str) -> None:
    rows = ticks(100)
    rows[200:, :, CONTROL[state]] += 0.05 if "v" in state else 0.01
    tick, name, _ = alarmed(rows)[0]
    assert (tick, name) == (200, state)


def test_what_is_too_small_for_one_tick_adds_up() -> None:
    rows = ticks(100)
    rows[200:, :, CONTROL["odometry.x"]] += 2e-4 * np.arange(200.0)[:, None]  # two deviations a tick: 5 mm/s
    found = alarmed(rows)
    assert found[0][1] == "odometry.x"
    assert 203 <= found[0][0] <= 240  # not by its first tick


def test_a_vehicle_that_answers_its_commands_too_weakly_is_seen() -> None:
    assert alarmed(ticks(100, answer=0.095)) != []
    weak = alarmed(ticks(100, answer=0.07, from_tick=200))
    assert 200 < weak[0][0] < 220


def test_an_alarm_is_not_remembered_and_nothing_before_a_reset_is() -> None:
    rows = ticks(100)
    rows[200, :, CONTROL["odometry.vx"]] += 1.0
    detector = Physical.load(PARAMETERS)
    for values in rows[:200]:
        assert detector.check("control", values) is None
    assert detector.check("control", rows[200]) is not None
    rows[200, :, CONTROL["odometry.vx"]] -= 1.0
    assert detector.score("control", rows[200]) < 1.0
    assert detector.check("control", rows[200]) is None
    detector.reset("control")
    assert detector.check("control", rows[0]) is None  # hundreds of ticks back: it follows nothing


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
@pytest.mark.parametrize("state", [*STATES, "command.vz"])
def test_what_is_not_finite_is_an_alarm_from_the_first_tick_on(state: str, wrong: float) -> None:
    values = ticks(100)[0]
    values[:, CONTROL[state]] = wrong
    found = Physical.load(PARAMETERS).check("control", values)
    assert found is not None
    assert found.score == math.inf


def test_other_stages_are_not_watched() -> None:
    detector = Physical.load(PARAMETERS)
    assert detector.check("perception", np.full((1, 2), math.nan)) is None
    assert detector.score("planning", np.full((3, 13), math.nan)) == 0.0


def test_parameters_of_another_shape_are_refused() -> None:
    for name, value in (("response", [[0.0] * 6] * 2), ("deviation", [0.0] * 6), ("largest_sums", [1.0])):
        with pytest.raises(ValueError, match=name):
            Physical.load({**PARAMETERS, name: value})


def test_a_jump_of_all_components_that_none_has_alone_is_seen_at_once() -> None:
    """Each by five deviations: no sum of one component is that large, all together are."""
    assert max(5.0 / np.array(PARAMETERS["largest_sums"])) < 0.5
    rows, parameters = ticks(100), PARAMETERS
    for state, deviation in zip(STATES, parameters["deviation"], strict=True):
        rows[200, :, CONTROL[state]] += 5.0 * deviation
    assert alarmed(rows)[0][0] == 200
