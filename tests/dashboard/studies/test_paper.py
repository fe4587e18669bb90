"""Our numbers beside the paper's are what they are said to be."""

from dataclasses import replace
from math import exp, sqrt

import pytest

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.presets import presets
from dashboard.campaigns.spec import Cell, cells, load_campaign
from dashboard.campaigns.statistics.proportions import newcombe, wilson
from dashboard.studies.paper import FINDINGS, STUDIES, success, worst
from dashboard.studies.study import TABLE
from dashboard.studies.verdict import judge
from tests.dashboard.web.components.test_views import record


def flown(arm: str, fault: str, *times_s: float, twin_s: float = 10.0) -> list[FlightRecord]:
    """Successful flights of a cell in Factory beside twins of ``twin_s``."""
    cell = Cell(arm, "factory", fault)
    return [
        replace(record(n, time_s=t, twin_success=True, twin_flight_time_s=twin_s), cell=cell)
        for n, t in enumerate(times_s)
    ]


def with_overhead(flight: FlightRecord, part: float) -> FlightRecord:
    assert flight.result is not None
    return replace(flight, result=replace(flight.result, overhead=part))


def test_success_is_a_part_and_the_worst_is_beside_its_own_twin() -> None:
    assert success([]) is None
    assert success([record(0), record(1, success=False)]) == 50
    assert worst([record(0)]) is None
    assert worst(flown("bare", "planning", 11.0, 15.0)) == pytest.approx(50)


def test_removed_is_the_part_of_the_worst_delay_that_is_gone() -> None:
    records = flown("bare", "planning", 11.0, 15.0) + flown("gaussian", "planning", 11.0, 12.0)
    found = {one.what: one.ours(records) for one in FINDINGS["table4"]}
    assert found["factory: longest flight over its golden twin (Fig. 12)"] == pytest.approx(50)
    assert found["factory, gaussian: of that delay removed (Fig. 12)"] == pytest.approx(60)
    assert found["factory, autoencoder: of that delay removed (Fig. 12)"] is None
    assert found["farm, injected: success"] is None


def test_overhead_is_the_mean_of_those_that_have_a_detector() -> None:
    bare, kept = flown("bare", "golden", 10.0), flown("gaussian", "golden", 10.0, 10.0, 10.0)
    parts = (0.01, 0.02, 0.03)
    records = bare + [with_overhead(one, part) for one, part in zip(kept, parts, strict=True)]
    found = {one.what: one for one in FINDINGS["table4"]}
    overhead = found["factory, gaussian: detection and recomputation (Table V)"]
    assert overhead.paper == pytest.approx(1.981)
    assert overhead.ours(records) == pytest.approx(2.0)
    assert overhead.interval(records) == pytest.approx((2 - 1.96 / sqrt(3), 2 + 1.96 / sqrt(3)), abs=1e-3)
    assert found["farm, gaussian: detection and recomputation (Table V)"].ours(records) is None


def test_the_cost_of_a_flight_is_that_of_those_that_were_flown() -> None:
    one, proven = record(0), record(1)
    assert one.result is not None
    assert proven.result is not None
    times = (2.0, 4.0)
    records = [replace(one, result=replace(one.result, wall_s=t)) for t in times]
    records.append(replace(proven, result=replace(proven.result, wall_s=0.0, proof="kernel output")))
    (single, thousand) = FINDINGS["table1"]
    assert (single.unit, thousand.unit) == ("s", "h")
    assert single.ours(records) == pytest.approx(3.0)
    assert thousand.ours(records) == pytest.approx(3000 / 3600)
    assert single.interval(records[:1]) is None


def test_means_are_over_the_golden_ones() -> None:
    records = [
        replace(record(n, time_s=t), cell=Cell(arm, "sparse", ""))
        for arm, times in (("golden", (10.0, 20.0)), ("3 bits", (15.0, 18.0)))
        for n, t in enumerate(times)
    ]
    found = {one.what: one for one in FINDINGS["table3"]}
    assert found["3 bits: time over golden, mean"].ours(records) == pytest.approx(10)
    assert found["3 bits: time over golden, mean"].paper == pytest.approx(13.4, abs=0.05)


def test_numbers_of_many_flights_have_intervals_and_the_longest_of_them_has_none() -> None:
    times = (10.0, 12.0, 14.0)
    records = [
        replace(record(n, time_s=1.1 * t if arm == "3 bits" else t), cell=Cell(arm, "sparse", ""))
        for arm in ("golden", "3 bits")
        for n, t in enumerate(times)
    ]
    found = {one.what: one.interval(records) for one in FINDINGS["table3"]}
    low, high = wilson(3, 3)
    assert found["3 bits: success"] == (100 * low, 100 * high)
    assert found["5 bits: success"] is None
    # Of both means, 12 and 13.2, the standard error is 2 / 12 / sqrt(3) of itself.
    over = found["3 bits: time over golden, mean"]
    assert over is not None
    spread = 1.959964 * (2 / 12) * (2 / 3) ** 0.5
    assert over == pytest.approx((100 * (1.1 * exp(-spread) - 1), 100 * (1.1 * exp(spread) - 1)))
    (longest, _) = FINDINGS["fig7"]
    assert longest.interval(records) is None


def test_the_largest_loss_is_bounded_by_all_arms_together() -> None:
    def arm(name: str, lost: int) -> list[FlightRecord]:
        flights = [record(n, success=n >= lost) for n in range(100)]
        return [replace(one, cell=Cell(name, "sparse", "")) for one in flights]

    (_, loss) = FINDINGS["fig7"]
    records = [*arm("golden", 2), *arm("pid", 12), *arm("octomap", 2)]
    assert loss.ours(records) == pytest.approx(10)
    low, high = newcombe((98, 88), (100, 100), 0.975)
    assert loss.interval(records) == pytest.approx((100 * low, 100 * high))
    assert judge(loss, records).verdict == "confirmed"
    assert judge(loss, [*arm("golden", 2), *arm("pid", 7)]).verdict == "not resolved"
    assert judge(loss, [*arm("golden", 0), *arm("pid", 0)]).verdict == "not confirmed"
    assert loss.interval(arm("golden", 0)) is None


def test_every_study_is_a_preset_whose_arms_the_findings_name() -> None:
    assert set(STUDIES) <= {one.name for one in presets()}
    assert set(FINDINGS) <= set(STUDIES)
    for name, findings in FINDINGS.items():
        assert "The paper" in TABLE[name].about
        records = [
            replace(with_overhead(record(n, twin_success=True, twin_flight_time_s=10.0), 0.01), cell=cell)
            for n, cell in enumerate(cells(load_campaign(name)))
        ]
        for one in findings:
            assert one.ours(records) is not None, (name, one.what)
