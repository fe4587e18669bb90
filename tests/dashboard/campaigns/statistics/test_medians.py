"""Intervals of medians: they cover, whatever the values are distributed like."""

import numpy as np
import pytest

from dashboard.campaigns.statistics.proportions import median_interval


def test_the_ends_lie_between_the_values_that_tables_of_order_statistics_name() -> None:
    # Conover, Practical Nonparametric Statistics, Table A3 (binomial, p = 1/2).
    for n, outer in ((6, 1), (10, 2), (20, 6), (30, 10)):
        found = median_interval([float(i) for i in range(n, 0, -1)])
        assert found is not None
        assert outer <= found.low < outer + 1
        assert found.low + found.high == pytest.approx(n + 1)


def test_the_level_of_two_values_gives_these_two() -> None:
    # Of the 2**6 ways two have all six values on one side. Just below that, as a level is not met exactly.
    found = median_interval([3.0, 1.0, 4.0, 1.5, 9.0, 2.0], level=1 - 2 / 2**6 - 1e-9)
    assert found == pytest.approx((1.0, 9.0))


def test_of_fewer_than_six_nothing_is_said() -> None:
    assert median_interval([]) is None
    assert median_interval([1.0, 2.0, 3.0, 4.0, 5.0]) is None


def test_it_covers_also_where_values_are_skewed() -> None:
    draw = np.random.default_rng(5)
    for n in (6, 8, 15, 60):
        found = [median_interval(list(draw.exponential(size=n))) for _ in range(4000)]
        hits = sum(one is not None and one.low <= np.log(2) <= one.high for one in found)
        assert 0.94 <= hits / 4000 <= 0.97
