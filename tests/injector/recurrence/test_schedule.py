"""When a fault that recurs strikes: drawn times and counts are those of their declared law."""

from itertools import islice

import numpy as np
import pytest
from scipy.stats import chisquare, geom, poisson

from injector.recurrence.schedule import gaps, intermittent_gaps, upset_executions, upsets
from services.models.fault_spec import FaultSpec

pytestmark = pytest.mark.unit

DRAWS, PARTS = 10_000, 50


def intermittent(probability: float, seed: int = 0) -> FaultSpec:
    return FaultSpec(target="pid", recurrence="intermittent", probability=probability, seed=seed)


def rate(rate_hz: float) -> FaultSpec:
    return FaultSpec(target="pid", recurrence="rate", rate_hz=rate_hz)


@pytest.mark.parametrize("probability", [0.3, 0.02])
def test_each_execution_is_struck_with_the_probability(probability: float) -> None:
    """Over many calls, of which each begins anew."""
    fault = intermittent(probability)
    found = [gap for call in range(DRAWS // 50) for gap in islice(intermittent_gaps(fault, 7, call), 50)]
    law = geom(probability)
    bounds = np.unique([0, *law.ppf(np.arange(1, 20) / 20)])
    counts = np.histogram(found, [*(bounds + 0.5), np.inf])[0]
    expected = np.diff([*law.cdf(bounds), 1.0]) * len(found)
    assert chisquare(counts, expected).pvalue > 0.01


def test_upsets_are_a_poisson_process_in_the_time_of_the_calls() -> None:
    fault, latency_ns = rate(500.0), 4_000_000
    calls = [upsets(fault, 7, call, latency_ns) for call in range(DRAWS // 2)]
    numbers = np.bincount([len(one) for one in calls], minlength=8)
    law = poisson(500.0 * latency_ns / 1e9)
    expected = law.pmf(np.arange(7)) * len(calls)
    assert (
        chisquare([*numbers[:7], numbers[7:].sum()], [*expected, len(calls) - expected.sum()]).pvalue > 0.01
    )
    parts = np.concatenate(calls)[:DRAWS]
    assert len(parts) > 0.95 * DRAWS
    assert chisquare(np.histogram(parts, PARTS, (0.0, 1.0))[0]).pvalue > 0.01
    assert all((np.diff(one) >= 0).all() for one in calls)


def test_the_times_between_upsets_are_exponential() -> None:
    fault, latency_ns = rate(100.0), 50_000_000
    times = [
        (call + part) * latency_ns
        for call in range(2200)
        for part in upsets(fault, 3, call, latency_ns).tolist()
    ]
    between = np.diff(times)[:DRAWS]
    assert len(between) == DRAWS
    bounds = -np.log1p(-np.arange(PARTS) / PARTS) * 1e9 / 100.0
    assert chisquare(np.histogram(between, [*bounds, np.inf])[0]).pvalue > 0.01


def test_seed_and_call_alone_say_what_is_drawn() -> None:
    def first(seed: int, call: int) -> list[int]:
        return list(islice(intermittent_gaps(intermittent(0.01, seed), 7, call), 5))

    assert first(0, 3) == first(0, 3)
    assert first(0, 3) != first(0, 4)
    assert first(0, 3) != first(1, 3)


def test_an_upset_is_in_the_execution_at_that_part_of_the_call() -> None:
    assert upset_executions(np.array([0.0, 0.5, 0.999]), 10) == [1, 6, 10]
    assert upset_executions(np.array([]), 10) == []
    assert upset_executions(np.array([0.5]), 0) == []


def test_no_two_upsets_share_an_execution() -> None:
    assert upset_executions(np.array([0.5, 0.5, 0.51]), 10) == [6, 7, 8]
    assert upset_executions(np.array([0.95, 0.96, 0.97]), 10) == [8, 9, 10]
    assert upset_executions(np.array([0.1, 0.2, 0.3, 0.4]), 3) == [1, 2, 3]


def test_gaps_lead_from_each_execution_to_the_next() -> None:
    assert list(gaps([2, 3, 9])) == [2, 1, 6]
