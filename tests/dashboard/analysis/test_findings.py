"""A sentence for each cell says what is resolved, and what the flights are too few to tell."""

import numpy as np

from dashboard.analysis.findings import findings
from dashboard.campaigns.results.compare import Comparison, Paired, compare
from dashboard.campaigns.results.summary import CellSummary, summarise
from tests.dashboard.campaigns.test_flight_record import CELLS, FLIP, GOLDEN, records, result, stored


def lines(failures: int, harmed: int = 0) -> list[CellSummary]:
    flights = [
        result(success=n >= failures, injection="injected", harm="mission_lost" if n < harmed else "")
        for n in range(50)
    ]
    golden = records(GOLDEN, [result() for _ in range(50)])
    return summarise(CELLS, stored(golden, records(FLIP, flights)), {})


def beside(failures: int) -> list[Comparison]:
    own = np.arange(50) >= failures
    return compare([Paired(FLIP, "golden", own, np.ones(50, bool), np.zeros((3, 0)))])


def test_an_effect_beyond_chance_is_told_with_its_interval() -> None:
    golden, flip = findings(lines(20, harmed=20), beside(20))
    assert golden == "golden, sparse: 50 of 50 missions succeeded (93 to 100 %)."
    assert flip.startswith("flip, sparse: 30 of 50 missions succeeded (46 to 72 %), 20 of 50 faults harmed.")
    assert "Success falls: -40 points beside golden (" in flip


def test_what_is_not_resolved_says_what_could_be() -> None:
    (_, flip) = findings(lines(1), beside(1))
    assert "No difference is resolved: -2 points beside golden (" in flip
    assert "p 1); 50 pairs tell a drop of " in flip


def test_a_cell_without_flights_says_so() -> None:
    empty = summarise(CELLS, stored(records(GOLDEN, [None])), {})
    assert findings(empty, [])[0] == "golden, sparse: nothing is flown yet."
