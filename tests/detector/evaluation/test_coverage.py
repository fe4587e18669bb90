"""What a detector catches before the harm, and the limit that a number of false alarms sets."""

import math

import numpy as np
import pytest

from detector.evaluation.coverage import HarmReport, JudgedFlight, at_budget, coverage, judged, limit_within
from detector.schemes.kinematic import Kinematic
from detector.series.series import Series
from tests.detector.flights import flight


def golden(*scores: float) -> JudgedFlight:
    return JudgedFlight(36.0, np.arange(float(len(scores))), np.array(scores))


def harmful(scores: dict[float, float], injected_s: float = 10.0, harmed_at_s: float = 20.0) -> JudgedFlight:
    report = HarmReport(
        struck="control",
        target="pid",
        fault_class="once",
        pilot="baseline",
        cause="data",
        injected_s=injected_s,
        harmed_at_s=harmed_at_s,
    )
    return JudgedFlight(36.0, np.array([*scores]), np.array([*scores.values()]), report)


def test_the_limit_keeps_the_budget_nine_times_in_ten_whatever_the_scores_are_like() -> None:
    draw = np.random.default_rng(5)
    kept = 0
    for _ in range(400):
        limit = limit_within([golden(0.0, one) for one in draw.lognormal(size=200)], 0.1)
        kept += math.erfc(math.log(limit) / math.sqrt(2)) / 2 <= 0.1
    assert 0.87 <= kept / 400 <= 0.97


def test_of_few_flights_the_limit_keeps_the_budget_nine_times_in_ten_if_their_tail_is_a_power() -> None:
    draw, rate, kept = np.random.default_rng(6), 1e-4, 0
    for _ in range(400):
        limit = limit_within([golden(0.0, 1.0 + one) for one in draw.pareto(2.0, 500)], rate)
        kept += limit**-2.0 <= rate
    assert 0.86 <= kept / 400 <= 0.97
    assert limit_within([golden(0.0, 1.0), golden(0.0, 3.0)], rate) >= 3.0


@pytest.mark.parametrize(("scores", "limit"), [((0.0, 0.0), 0.0), ((0.0, math.inf), math.inf)])
def test_who_never_alarms_needs_no_limit_and_who_is_sure_of_it_has_none(
    scores: tuple[float, ...], limit: float
) -> None:
    assert limit_within([golden(one) for one in scores], 1e-3) == limit


def test_an_alarm_counts_from_the_fault_to_the_harm() -> None:
    found = coverage(
        1.0,
        [golden(0.5, 1.5, 2.0), golden(0.5)],
        [
            harmful({5.0: 9.0, 12.0: 2.0, 15.0: 9.0}),
            harmful({5.0: 9.0, 19.0: 0.9, 21.0: 9.0}),
            harmful({5.0: 9.0, 12.0: 0.5}),
            harmful({10.0: math.inf}),
            harmful({20.0: 2.0}),
        ],
    )
    assert [one.alarm_s for one in found.verdicts] == [12.0, 21.0, None, 10.0, 20.0]
    assert [one.in_time for one in found.verdicts] == [True, False, False, True, False]
    assert [one.margin_s for one in found.verdicts] == [8.0, -1.0, None, 10.0, 0.0]
    assert (found.in_time, found.alarms, found.flights) == (2, 1, 2)
    assert found.hours == pytest.approx(0.02)


def test_flights_that_set_the_limit_tell_no_false_alarms() -> None:
    flights = [golden(one, 0.1) for pair in zip(range(1, 51), range(101, 151), strict=True) for one in pair]
    found = at_budget([*flights, harmful({12.0: 50.5}), harmful({12.0: 44.0})], 0.2, 0.0)
    # Of 50 flights 5 may exceed the limit: with a rate above 0.2 so few would in one case of ten at most.
    assert (found.limit, found.flights, found.alarms, found.in_time) == (45.0, 50, 50, 1)
    # 36 s each: 20 in an hour.
    assert at_budget(flights, 0.0, 20.0) == at_budget(flights, 0.2, 0.0) == at_budget(flights, 0.1, 10.0)
    assert at_budget(flights, 0.0, 0.0).limit == math.inf


def test_a_flight_is_judged_as_in_flight() -> None:
    flights = [flight(phase, seed) for seed, phase in enumerate(np.linspace(0.0, 6.0, 5))]
    model = Kinematic.train([Kinematic.lesson(one) for one in flights], 0)
    calm = judged(Kinematic.load(model), flights[0])
    assert len(calm.scores) == sum(len(one) for one in flights[0].checks.values())
    assert (np.diff(calm.times_s) >= 0.0).all()
    assert calm.largest <= 1.0
    ticks = flights[0].checks["control"]
    values = ticks.values.copy()
    values[ticks.first[100] + 1, 11] = 50.0
    struck = type(ticks)(values, ticks.first, ticks.times_s)
    found = judged(Kinematic.load(model), Series({**flights[0].checks, "control": struck}, flights[0].about))
    # What was alarmed is no predecessor: the next checks are judged as before.
    assert found.times_s[found.scores > 1.0].tolist() == [ticks.times_s[100]]
