"""Summaries, comparisons and exports of flights whose results are known."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from pyarrow import parquet
from rich.console import Console

from dashboard.analysis import tables
from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.results import export
from dashboard.campaigns.results.compare import compare, with_others, with_twins
from dashboard.campaigns.results.summary import summarise
from dashboard.campaigns.spec import Cell
from dashboard.campaigns.statistics.proportions import wilson
from dashboard.campaigns.store.columns import Rows, of_records
from deploy.errors import BadSpecError

GOLDEN, FLIP = Cell("golden", "sparse", ""), Cell("flip", "sparse", "")
CELLS = [GOLDEN, FLIP]


def result(
    *,
    success: bool = True,
    time_s: float = 20.0,
    injection: str = "",
    node_result: str = "",
    harm: str | None = "",
) -> Result:
    faulty = injection != ""
    return Result(
        result="success" if success else "collision",
        success=success,
        flight_time_s=time_s,
        distance_m=50.0,
        energy_kj=10.0,
        replans=1,
        min_clearance_m=1.0,
        injection=injection,
        node="control" if faulty else "",
        node_result=node_result,
        twin_result="success" if faulty else "",
        twin_success=True if faulty else None,
        twin_flight_time_s=20.0 if faulty else None,
        twin_distance_m=50.0 if faulty else None,
        twin_energy_kj=10.0 if faulty else None,
        twin_digest="twin" if faulty else "",
        alarms=None,
        recomputed=0,
        overhead=None,
        proof="",
        harm=harm if faulty else None,
        harmed_at_s=12.5 if faulty and harm else None,
        digest="",
        wall_s=1.0,
    )


def records(cell: Cell, results: Sequence[Result | None]) -> list[FlightRecord]:
    return [
        FlightRecord(cell, number, number, "done" if one is not None else "failed", 1, "", one, number)
        for number, one in enumerate(results)
    ]


def stored(*several: Sequence[FlightRecord]) -> Rows:
    """Runs of both cells as a store has them."""
    return of_records(CELLS, [one for some in several for one in some])


FLIPS = records(
    FLIP,
    [
        result(injection="injected", node_result="benign"),
        result(injection="injected", node_result="sdc", time_s=26.0),
        result(injection="injected", node_result="crash", success=False, harm="mission_lost"),
        result(injection="not_reached", node_result="benign"),
        None,
    ],
)


def test_every_denominator_is_shown() -> None:
    golden, flip = summarise(CELLS, stored(records(GOLDEN, [result()] * 4), FLIPS), {})
    assert (golden.runs, golden.successes, golden.aimed) == (4, 4, 0)
    assert (flip.planned, flip.runs, flip.failed_to_fly) == (5, 5, 1)
    assert (flip.success_low, flip.success_high) == wilson(3, 4)
    assert (flip.aimed, flip.injected) == (4, 3)
    assert flip.results == {"benign": 1, "sdc": 1, "crash": 1}
    assert flip.flight_time_s == 20.0
    assert flip.energy_per_success_kj == pytest.approx(40 / 3)


def test_harm_is_counted_of_injected_flights_of_which_it_is_known(tmp_path: Path) -> None:
    golden, flip = summarise(CELLS, stored(records(GOLDEN, [result()] * 4), FLIPS), {})
    assert (golden.harmed, flip.harmed) == (None, 1)
    before = [result(injection="injected", harm=None)]
    assert summarise(CELLS, stored(records(FLIP, before)), {})[1].harmed is None
    export.write(FLIPS, tmp_path / "runs.csv")
    export.write_summary([flip], tmp_path / "cells.csv")
    with (tmp_path / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["harm"], row["harmed_at_s"]) for row in rows[1:3]] == [("", ""), ("mission_lost", "12.5")]
    with (tmp_path / "cells.csv").open() as file:
        assert [row["harmed"] for row in csv.DictReader(file)] == ["1"]


def test_a_cell_without_flights_knows_nothing() -> None:
    one, _ = summarise(CELLS, stored(), {})
    assert (one.runs, one.success_low, one.success_high, one.flight_time_s) == (0, 0.0, 1.0, None)


def test_flights_are_compared_with_their_twins() -> None:
    (one,) = compare(with_twins(CELLS, stored(records(GOLDEN, [result()] * 4), FLIPS)))
    assert one.cell == "flip / sparse"
    assert (one.pairs, one.successes, one.reference_successes) == (4, 3, 4)
    assert one.success_difference == -0.25
    assert one.p_value == 1.0
    assert one.flight_time_s.pairs == 3
    assert one.flight_time_s.median == 0.0
    assert one.flight_time_s.p95 == 6.0


def test_flights_of_other_arms_are_paired_by_number_and_seed() -> None:
    others = records(GOLDEN, [result(time_s=19.0), result(time_s=19.0)])
    (one,) = compare(with_others(CELLS, stored(FLIPS), stored(others), "golden", [-1, 0]))
    assert one.pairs == 2
    assert one.flight_time_s.median == pytest.approx(4.0)


def test_only_flights_of_one_number_and_seed_are_pairs() -> None:
    others = records(GOLDEN, [result(), None, *[result()] * 3])
    others[2] = replace(others[2], seed=77)
    (one,) = compare(with_others(CELLS, stored(FLIPS), stored(others), "golden", [-1, 0]))
    assert one.pairs == 2  # one of five was not flown in either, and one has another seed


def test_p_values_are_adjusted_for_how_many_cells_are_compared() -> None:
    losses = [result(injection="injected", success=False)] * 6
    alone = compare(with_twins(CELLS, stored(records(FLIP, losses))))
    beside = compare(with_twins(CELLS, stored(records(FLIP, losses), records(GOLDEN, losses))))
    assert alone[0].p_adjusted == alone[0].p_value == 2 * 0.5**6
    assert beside[0].p_adjusted == 4 * 0.5**6


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_an_export_has_a_row_per_run(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"table.{ending}"
    export.write(FLIPS, path)
    if ending == "csv":
        with path.open() as file:
            rows = list(csv.DictReader(file))
        assert rows[4]["flight_time_s"] == ""
    else:
        rows = parquet.read_table(path).to_pylist()
        assert rows[4]["flight_time_s"] is None
        assert rows[0]["twin_success"] is True
    assert len(rows) == 5
    assert float(rows[1]["flight_time_s"]) == 26.0
    assert rows[2]["node_result"] == "crash"
    assert list(tmp_path.iterdir()) == [path]


def test_an_export_of_no_known_form_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadSpecError, match="csv or"):
        export.write(FLIPS, tmp_path / "table.xlsx")
    with pytest.raises(BadSpecError, match="nowhere"):
        export.write(FLIPS, tmp_path / "nowhere" / "table.csv")


def test_tables_fit_a_terminal() -> None:
    wide = records(
        FLIP, [result(injection="injected", time_s=20.0 + 2 * n, success=n != 3) for n in range(40)]
    )
    for table in (
        tables.comparison("x-1", compare(with_twins(CELLS, stored(wide)))),
        tables.campaign("x-1", summarise(CELLS, stored(wide), {})),
    ):
        paper = Console(file=StringIO(), width=200)
        paper.print(table)
        assert isinstance(paper.file, StringIO)
        lines = paper.file.getvalue().splitlines()
        assert max(len(line.rstrip()) for line in lines) <= 80
