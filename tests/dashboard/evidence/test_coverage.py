"""Harm is averted only where the fault was there."""

from dataclasses import replace

import pytest

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.spec import Cell
from dashboard.evidence.coverage import is_averted
from tests.dashboard.campaigns.test_flight_record import result

STRUCK = result(injection="injected")


@pytest.mark.parametrize(
    ("flight", "averted"),
    [
        (STRUCK, True),
        (result(injection="injected", harm="too_slow"), False),
        (replace(STRUCK, harm=None), False),
        (replace(STRUCK, injection="not_reached"), False),
        (None, False),
    ],
)
def test_harm_is_averted_only_if_the_fault_struck(flight: Result | None, averted: bool) -> None:
    cell = Cell("watched", "sparse", "pid")
    assert is_averted(FlightRecord(cell, 0, 0, "done", 1, "", flight, 0)) is averted
