"""When a fault that recurs strikes: drawn times and counts are those of their declared law."""

from itertools import accumulate, islice, takewhile

import numpy as np
import pytest
from scipy.stats import chisquare, geom, poisson

from injector.recurrence.schedule import chance, draw_of_strike, gaps
from services.models.faults.arithmetic import draw_bits
from services.models.faults.specification import FaultSpec

pytestmark = pytest.mark.unit

DRAWS, PARTS = 10_000, 50


def intermittent(probability: float, seed: int = 0) -> FaultSpec:
    return FaultSpec(target="pid", recurrence="intermittent", probability=probability, seed=seed)


def rate(rate_hz: float) -> FaultSpec:
    return FaultSpec(target="pid", recurrence="rate", rate_hz=rate_hz)


def in_calls(fault: FaultSpec, calls: int, latency_ns: int = 0, executions: int = 0) -> list[list[int]]:
    """Which executions of each call are struck, from 0; each call has as many as are expected."""
    found = []
    for call in range(calls):
        drawn = accumulate(gaps(fault, 7, call, chance(fault, latency_ns, executions)))
        found.append([at - 1 for at in takewhile(lambda at: at <= executions, drawn)])
    return found


@pytest.mark.parametrize("probability", [0.3, 0.02])
def test_each_execution_is_struck_with_the_probability(probability: float) -> None:
    """Over many calls, of which each begins anew."""
    fault, law = intermittent(probability), geom(probability)
    calls = (gaps(fault, 7, call, chance(fault, 0, 0)) for call in range(DRAWS // 50))
    found = [gap for call in calls for gap in islice(call, 50)]
    bounds = np.unique([0, *law.ppf(np.arange(1, 20) / 20)])
    counts = np.histogram(found, [*(bounds + 0.5), np.inf])[0]
    expected = np.diff([*law.cdf(bounds), 1.0]) * len(found)
    assert chisquare(counts, expected).pvalue > 0.01


def test_each_execution_is_as_likely_as_any_other_whatever_the_call_had_before() -> None:
    found = in_calls(intermittent(0.05), DRAWS // 10, executions=200)
    assert abs(sum(map(len, found)) - DRAWS) < 400
    assert chisquare(np.histogram(np.concatenate(found), PARTS, (0, 200))[0]).pvalue > 0.01


def test_upsets_are_a_poisson_process_in_the_time_of_the_calls() -> None:
    fault, latency_ns, executions = rate(500.0), 4_000_000, 100_000
    calls = in_calls(fault, DRAWS // 2, latency_ns, executions)
    numbers = np.bincount([len(one) for one in calls], minlength=8)
    law = poisson(500.0 * latency_ns / 1e9)
    expected = law.pmf(np.arange(7)) * len(calls)
    assert (
        chisquare([*numbers[:7], numbers[7:].sum()], [*expected, len(calls) - expected.sum()]).pvalue > 0.01
    )
    times = [(call + at / executions) * latency_ns for call, struck in enumerate(calls) for at in struck]
    assert abs(len(times) - DRAWS) < 400
    bounds = -np.log1p(-np.arange(PARTS) / PARTS) * 1e9 / 500.0
    assert chisquare(np.histogram(np.diff(times), [*bounds, np.inf])[0]).pvalue > 0.01


def test_seed_and_call_alone_say_what_is_drawn() -> None:
    def first(seed: int, call: int) -> list[int]:
        return list(islice(gaps(intermittent(0.01, seed), 7, call, 0.01), 5))

    assert first(0, 3) == first(0, 3)
    assert first(0, 3) != first(0, 4)
    assert first(0, 3) != first(1, 3)


def test_a_call_that_takes_no_time_has_no_upsets() -> None:
    assert chance(rate(500.0), 0, 100) == 0.0
    assert chance(rate(500.0), 10**6, 0) == 0.0
    assert list(gaps(rate(500.0), 7, 0, 0.0)) == []


def test_bits_are_drawn_for_each_strike_alike() -> None:
    fault = intermittent(0.5)
    drawn = [
        draw_bits(fault, [range(64)], draw_of_strike(fault, 7, number // 50, number % 50))[0]
        for number in range(DRAWS)
    ]
    assert chisquare(np.bincount(drawn, minlength=64)).pvalue > 0.01
