"""Bootstrap intervals: they repeat, and they cover."""

import numpy as np
import pytest
from scipy import stats

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


@pytest.mark.parametrize(("quantile", "flights"), [(0.5, 40), (0.5, 41), (0.95, 200), (0.95, 12)])
def test_the_interval_is_that_of_whole_resamples(quantile: float, flights: int) -> None:
    data = np.random.default_rng(5).exponential(size=flights)
    found = quantile_interval(data, quantile, seed=1, resamples=20_000)

    def statistic(values: np.ndarray, axis: int) -> np.ndarray:
        return np.asarray(np.quantile(values, quantile, axis=axis, method="weibull"))

    whole = stats.bootstrap(
        (data,), statistic, n_resamples=20_000, method="percentile", rng=np.random.default_rng(2)
    ).confidence_interval
    assert found is not None
    # What is left is the chance of 20,000 draws, a fiftieth of the interval.
    assert found == pytest.approx((whole.low, whole.high), abs=0.04 * found.width)


# A tenth as many tell three times as roughly.
@pytest.mark.parametrize(
    ("campaigns", "low", "high"), [(100, 0.90, 0.99), pytest.param(4000, 0.93, 0.96, marks=pytest.mark.soak)]
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
