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


@pytest.mark.parametrize(("most", "limit"), [(0, 5.0), (1, 3.0), (2, 2.0), (4, 0.0), (9, 0.0)])
def test_the_limit_is_the_lowest_with_so_many_false_alarms(most: int, limit: float) -> None:
    flights = [golden(1.0, 5.0), golden(2.0, 3.0)]
    assert limit_within(flights, most) == limit
    assert sum(one.alarms(limit) for one in flights) <= most


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
    assert (found.in_time, found.alarms, found.alarmed, found.flights) == (2, 2, 1, 2)
    assert found.hours == pytest.approx(0.02)


def test_flights_that_set_the_limit_tell_no_false_alarms() -> None:
    flights = [golden(1.0), golden(7.0), golden(2.0), golden(0.5), golden(3.0), golden(2.5)]
    found = at_budget([*flights, harmful({12.0: 2.6})], 0.0, 0.0)
    assert (found.limit, found.flights, found.alarms, found.in_time) == (3.0, 3, 1, 0)
    assert at_budget(flights, 0.4, 0.0).limit == 2.0
    # 36 s each: a false alarm in 0.03 h.
    assert at_budget(flights, 0.0, 34.0).limit == 2.0
    assert at_budget(flights, 0.0, 33.0).limit == 3.0


def test_a_flight_is_judged_as_in_flight() -> None:
    flights = [flight(phase, seed) for seed, phase in enumerate(np.linspace(0.0, 6.0, 5))]
    model = Kinematic.train([Kinematic.lesson(one) for one in flights], 0)
    calm = judged(Kinematic.load(model), flights[0])
    assert len(calm.scores) == sum(len(one) for one in flights[0].checks.values())
    assert (np.diff(calm.times_s) >= 0.0).all()
    assert calm.alarms(1.0) == 0
    ticks = flights[0].checks["control"]
    values = ticks.values.copy()
    values[ticks.first[100] + 1, 11] = 50.0
    struck = type(ticks)(values, ticks.first, ticks.times_s)
    found = judged(Kinematic.load(model), Series({**flights[0].checks, "control": struck}, flights[0].about))
    # What was alarmed is no predecessor: the next checks are judged as before.
    assert found.times_s[found.scores > 1.0].tolist() == [ticks.times_s[100]]
