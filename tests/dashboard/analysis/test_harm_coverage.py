"""Intervals of false alarms, against values from tables."""

import pytest

from dashboard.analysis.harm_coverage import events_interval


def test_false_alarms_have_an_exact_interval() -> None:
    assert events_interval(0) == pytest.approx((0.0, 3.689), abs=5e-4)
    assert events_interval(5) == pytest.approx((1.623, 11.668), abs=5e-4)
