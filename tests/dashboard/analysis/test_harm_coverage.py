"""Bounds and intervals of what detectors catch, against values from tables."""

import pytest

from dashboard.analysis.harm_coverage import events_interval, lower_bound


def test_the_bound_of_coverage_is_one_sided() -> None:
    assert lower_bound(300, 300, 0.95) == pytest.approx(0.05 ** (1 / 300))
    assert lower_bound(300, 300, 0.99) == pytest.approx(0.01 ** (1 / 300))
    assert lower_bound(0, 300, 0.95) == 0.0
    assert lower_bound(8, 10, 0.95) == pytest.approx(0.4931, abs=5e-5)


def test_false_alarms_have_an_exact_interval() -> None:
    assert events_interval(0) == pytest.approx((0.0, 3.689), abs=5e-4)
    assert events_interval(5) == pytest.approx((1.623, 11.668), abs=5e-4)
