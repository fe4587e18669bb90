"""Where harm lies: place, part of the number and phase of the flight, from what campaigns kept."""

import csv
from dataclasses import replace
from pathlib import Path

import pytest

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.spec import Cell, campaign_of
from dashboard.studies import sensitivity_page
from dashboard.studies.ranking import KernelRate
from dashboard.studies.sensitivity import (
    MapField,
    MappedCampaign,
    SensitivityMap,
    most_sensitive,
    part_struck,
    phase_names,
    sensitivity,
)
from services.models.outcome import InjectionRecord
from tests.dashboard.web.components.test_views import record

TWIN_S = 20.0


def injection(at_s: float, *bits: int, element_bits: int = 64, strikes: int = 0) -> InjectionRecord:
    return InjectionRecord(
        status="injected",
        node="planning",
        kernel="",
        invocation=0,
        state=["trajectory.position"],
        element_bits=element_bits,
        bits=list(bits),
        virtual_time_ns=round(at_s * 1e9),
        strikes=strikes,
    )


SPEC = campaign_of(
    {
        "name": "x",
        "runs": 9,
        "arms": [
            {"name": "bare", "mission": {"pilot": "baseline"}},
            {"name": "watched", "mission": {"detector": {"scheme": "kinematic"}}},
        ],
        "faults": [
            {"name": "golden"},
            {"name": "way", "fault": {"level": "source", "target": "trajectory.position"}},
        ],
    }
)


def flights(
    *told: tuple[str | None, InjectionRecord], arm: str = "bare", status: str = "injected"
) -> tuple[list[FlightRecord], dict[int, InjectionRecord]]:
    """Runs with this harm and this injection."""
    runs = []
    for number, (harm, _) in enumerate(told):
        run = record(number, twin_success=True, twin_flight_time_s=TWIN_S)
        assert run.result is not None
        result = replace(run.result, harm=harm, injection=status)
        runs.append(replace(run, id=number, cell=Cell(arm, "sparse", "way"), result=result))
    return runs, {number: one for number, (_, one) in enumerate(told)}


def mapped(runs: list[FlightRecord], records: dict[int, InjectionRecord]) -> SensitivityMap:
    return sensitivity([MappedCampaign(SPEC, runs, records)])


@pytest.mark.parametrize(
    ("bits", "element_bits", "part"),
    [
        ((63,), 64, "sign"),
        ((62,), 64, "exponent"),
        ((52,), 64, "exponent"),
        ((51,), 64, "mantissa, upper"),
        ((25,), 64, "mantissa, lower"),
        ((31 + 32,), 32, "sign"),
        ((23,), 32, "exponent"),
        ((9,), 0, "bits 8-15"),
        ((8, 15), 0, "bits 8-15"),
        ((63, 62), 64, "several bits"),
    ],
)
def test_a_part_is_that_of_the_number_that_was_struck(
    bits: tuple[int, ...], element_bits: int, part: str
) -> None:
    assert part_struck(injection(1.0, *bits, element_bits=element_bits)) == part


def test_each_fault_stands_in_the_phase_of_its_twins_flight() -> None:
    assert phase_names(3) == ["0-33 %", "33-67 %", "67-100 %", "after"]
    times = (0.0, 6.6, 6.7, 19.9, 20.1, 60.0)
    found = mapped(*flights(*(("lost" if at > 20 else "", injection(at, 62)) for at in times)))
    struck = {at.phase: rate for at, rate in found.fields.items()}
    assert struck == {
        "0-33 %": KernelRate(0, 2),
        "33-67 %": KernelRate(0, 1),
        "67-100 %": KernelRate(0, 1),
        "after": KernelRate(2, 2),
    }
    assert {at[:3] for at in found.fields} == {("baseline", "trajectory.position", "exponent")}
    assert found.over_phases("baseline", "trajectory.position", "exponent") == KernelRate(2, 6)


def test_what_says_nothing_is_left_out_and_counted() -> None:
    runs, records = flights(
        ("", injection(1.0, 62)),
        (None, injection(1.0, 62)),
        ("lost", injection(1.0, 62, strikes=4)),
        ("lost", injection(1.0)),
    )
    unflown = replace(runs[0], id=9, result=None)
    assert mapped([*runs, unflown], records).left_out == {
        "beside no golden twin": 1,
        "struck again and again": 1,
        "not in bits": 1,
        "not flown": 1,
    }
    assert mapped(*flights(("lost", injection(1.0, 62)), status="not_activated")).left_out == {
        "not struck": 1
    }
    assert mapped(*flights(("lost", injection(1.0, 62)), arm="watched")).left_out == {"with a detector": 1}
    golden = replace(runs[0], cell=Cell("bare", "sparse", "golden"))
    assert mapped([golden], {}) == SensitivityMap(phase_names(3), {}, {})


def test_the_most_sensitive_are_those_that_harm_for_certain() -> None:
    at = [MapField("guarded", "pid", "sign", phase) for phase in phase_names(3)]
    few, many, none = KernelRate(1, 1), KernelRate(70, 100), KernelRate(0, 100)
    told = most_sensitive(SensitivityMap(phase_names(3), dict(zip(at, (few, many, none), strict=False)), {}))
    assert [field.phase for field, _, _ in told] == ["33-67 %", "0-33 %"]


def test_a_map_is_a_page_a_table_and_a_figure(tmp_path: Path) -> None:
    found = mapped(*flights(("lost", injection(1.0, 62)), ("", injection(1.0, 3)), ("", injection(15.0, 62))))
    sensitivity_page.write(tmp_path, ["x-1"], found)
    page = (tmp_path / "README.md").read_text()
    assert "3 faults struck once, 1 of them harmed." in page
    assert "| exponent | 100 (21 to 100) of 1 |  | 0 (0 to 79) of 1 |  | 50 (9 to 91) of 2 |" in page
    assert "zenfi study map x-1 --phases 3" in page
    assert "<svg" in (tmp_path / "map.svg").read_text()
    with (tmp_path / "map.csv").open(newline="") as file:
        rows = [(row["part"], row["phase"], row["struck"], row["harmed"]) for row in csv.DictReader(file)]
    assert rows == [
        ("exponent", "0-33 %", "1", "1"),
        ("mantissa, lower", "0-33 %", "1", "0"),
        ("exponent", "67-100 %", "1", "0"),
    ]
