"""The predictor, on error-free flights made of formulas."""

import math

import numpy as np
import pytest

from detector.schemes.predictor import OUTPUTS, RATE, Predictor, PredictorParameters, conformal_rank, errors
from detector.series.series import Checks, Series
from tests.detector.flights import COLUMNS, TICK_S, planned, tracked

CONTROL = COLUMNS["control"]
COMMAND = slice(CONTROL["command.vx"], CONTROL["command.vx"] + 3)


def flight(seed: int) -> Series:
    """A flight whose commands are off by what is drawn, more in some flights than in others."""
    draw = np.random.default_rng(seed)
    rows = np.array(tracked(planned(0.0, rows=30)))
    rows[:, :, COMMAND] += draw.normal(0.0, draw.uniform(0.01, 0.1), (len(rows), 1, 3))
    count = len(rows)
    control = Checks(rows.reshape(2 * count, -1), 2 * np.arange(count), TICK_S * np.arange(float(count)))
    return Series({"control": control}, {})


@pytest.fixture(scope="module")
def lessons() -> list[dict[str, np.ndarray]]:
    return [dict(Predictor.lesson(flight(seed))) for seed in range(40)]


@pytest.fixture(scope="module")
def parameters(lessons: list[dict[str, np.ndarray]]) -> dict[str, object]:
    return Predictor.train(lessons, 0)


def alarms(detector: Predictor, one: Series) -> int:
    checks, found = one.checks["control"], 0
    for index in range(len(checks)):
        if detector.check("control", checks.values[checks.rows(index)]) is not None:
            found += 1
            detector.reset("control")
    return found


def test_no_more_flights_have_an_alarm_than_were_promised(parameters: dict[str, object]) -> None:
    others = 200
    numbers = range(1000, 1000 + others)
    alarmed = sum(alarms(Predictor.load(parameters), flight(seed)) > 0 for seed in numbers)
    # Of 20 flights that calibrate the 19th sets the limit: 2 in 21 are expected beyond, but for its luck.
    assert 0 < alarmed < (RATE + 0.12) * others


def test_what_a_flight_scores_is_what_its_lesson_says(parameters: dict[str, object]) -> None:
    one, detector = flight(7), Predictor.load(parameters)
    model = PredictorParameters.model_validate(parameters)
    off = np.abs(errors(model.numbers(), Predictor.lesson(one))).max(axis=1) / model.threshold
    checks, scores = one.checks["control"], []
    for index in range(len(checks)):
        values = checks.values[checks.rows(index)]
        scores.append(detector.score("control", values))
        assert (detector.check("control", values) is None) == (scores[-1] <= 1.0)
        if scores[-1] > 1.0:
            break
    assert scores[0] == 0.0  # nothing came before
    assert scores[1:] == pytest.approx(off[: len(scores) - 1], rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("state", OUTPUTS)
def test_a_command_that_does_not_follow_is_named(parameters: dict[str, object], state: str) -> None:
    detector, ticks = Predictor.load(parameters), tracked(planned(0.0, rows=30))
    for values in ticks[:20]:
        assert detector.check("control", values) is None
    values = ticks[20].copy()
    values[:, CONTROL[state]] += 2.0
    alarm = detector.check("control", values)
    assert alarm is not None
    assert alarm.state == state
    for off in (2.0, 1e6):
        values = ticks[20].copy()
        values[:, CONTROL[state]] += off
        assert detector.check("control", values) is not None
        assert detector.check("control", ticks[20]) is None  # what was alarmed is no predecessor


def test_what_is_not_finite_is_an_alarm_from_the_first_tick_on(parameters: dict[str, object]) -> None:
    values = tracked(planned())[0]
    for column in range(values.shape[1]):
        wrong = values.copy()
        wrong[1, column] = math.nan
        found = Predictor.load(parameters).check("control", wrong)
        assert found is not None
        assert found.score == math.inf


def test_the_same_lessons_and_seed_give_the_same_model(
    lessons: list[dict[str, np.ndarray]], parameters: dict[str, object]
) -> None:
    assert Predictor.train(lessons, 0) == parameters


def test_the_rank_keeps_the_promise_or_there_are_too_few_flights() -> None:
    assert [conformal_rank(count) for count in (9, 19, 20, 99, 100)] == [9, 18, 19, 90, 91]
    with pytest.raises(ValueError, match="8 flights calibrate, at least 9"):
        conformal_rank(8)


def test_parameters_of_another_shape_are_refused(parameters: dict[str, object]) -> None:
    for name, value in (("scale", [1.0] * 22), ("deviation", [0.0] * 3), ("threshold", 0.0)):
        with pytest.raises(ValueError, match=name):
            Predictor.load({**parameters, name: value})
    layer = {"weight": [[0.0] * 24] * 3, "bias": [0.0] * 3}
    with pytest.raises(ValueError, match="23-24-12-3"):
        Predictor.load({**parameters, "layers": [layer] * 3})
