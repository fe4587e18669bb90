"""Bootstrap intervals: they repeat, and they cover."""

import numpy as np
import pytest

from dashboard.campaigns.statistics.differences import quantile_interval


def test_same_data_and_seed_give_the_same_interval() -> None:
    data = list(np.random.default_rng(1).normal(size=50))
    first = quantile_interval(data, 0.5, seed=3)
    assert first == quantile_interval(data, 0.5, seed=3)
    assert first != quantile_interval(data, 0.5, seed=4)
    assert first is not None
    assert first.low < np.median(data) < first.high


def test_too_few_differences_have_no_interval() -> None:
    assert quantile_interval([], 0.5, seed=0) is None
    assert quantile_interval([1.0], 0.5, seed=0) is None
    assert quantile_interval([2.0, 2.0, 2.0], 0.5, seed=0) == (2.0, 2.0)


# A tenth as many tell three times as roughly.
@pytest.mark.parametrize(
    ("campaigns", "low", "high"), [(100, 0.90, 0.99), pytest.param(1000, 0.94, 0.97, marks=pytest.mark.soak)]
)
@pytest.mark.parametrize(("quantile", "flights", "truth"), [(0.5, 100, 0.0), (0.95, 200, 1.6448536)])
def test_the_interval_covers(
    quantile: float, flights: int, truth: float, campaigns: int, low: float, high: float
) -> None:
    draw = np.random.default_rng(17)
    hits = 0
    for seed in range(campaigns):
        interval = quantile_interval(list(draw.normal(size=flights)), quantile, seed, resamples=800)
        assert interval is not None
        hits += interval.low <= truth <= interval.high
    assert low <= hits / campaigns <= high
