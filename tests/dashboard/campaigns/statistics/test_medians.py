"""Intervals of medians: they cover, whatever the values are distributed like."""

import numpy as np

from dashboard.campaigns.statistics.proportions import median_interval


def test_the_ends_are_the_values_that_tables_of_order_statistics_name() -> None:
    # Conover, Practical Nonparametric Statistics, Table A3 (binomial, p = 1/2).
    for n, low in ((6, 1), (10, 2), (20, 6), (30, 10)):
        assert median_interval([float(i) for i in range(n, 0, -1)]) == (low, n + 1 - low)


def test_of_fewer_than_six_nothing_is_said() -> None:
    assert median_interval([]) is None
    assert median_interval([1.0, 2.0, 3.0, 4.0, 5.0]) is None


def test_it_covers_also_where_values_are_skewed() -> None:
    draw = np.random.default_rng(5)
    for n in (6, 15, 60):
        found = [median_interval(list(draw.exponential(size=n))) for _ in range(2000)]
        hits = sum(one is not None and one.low <= np.log(2) <= one.high for one in found)
        assert 0.94 <= hits / 2000 <= 0.98
