"""What a detector made of a fault is told in one of four words, each with its meaning."""

from dataclasses import replace

import pytest

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.results.detection_effects import effect
from dashboard.campaigns.results.summary import summarise
from dashboard.campaigns.spec import Arm, CampaignSpec, Cell, Condition, unprotected_arms
from dashboard.campaigns.store.columns import of_records
from services.models.faults.specification import FaultSpec
from tests.dashboard.campaigns.test_flight_record import result

STRUCK = replace(result(injection="injected", time_s=26.0), digest="own", alarms=0)
CAUGHT = replace(STRUCK, alarms=2, recomputed=1, flight_time_s=21.0)
BARE = replace(STRUCK, alarms=None)
LOST = replace(result(injection="injected", success=False), digest="own")


@pytest.mark.parametrize(
    ("flight", "expected"),
    [
        (STRUCK, "missed"),
        (replace(STRUCK, digest="twin"), "unaffected"),
        (replace(STRUCK, alarms=1), "caught"),
        (BARE, None),
        (replace(STRUCK, injection="not_reached"), None),
        (replace(STRUCK, twin_digest=""), None),
    ],
)
def test_without_a_flight_to_compare_with_it_is_missed_caught_or_unaffected(
    flight: Result, expected: str | None
) -> None:
    assert effect(flight) == expected
    assert effect(replace(flight, recomputed=1)) == expected


@pytest.mark.parametrize(
    ("flight", "bare", "expected"),
    [
        (CAUGHT, BARE, "recovered"),
        (CAUGHT, LOST, "recovered"),
        (CAUGHT, replace(BARE, flight_time_s=20.5), "caught"),
        (CAUGHT, replace(BARE, flight_time_s=21.0), "caught"),
        (replace(CAUGHT, recomputed=0), BARE, "caught"),
        (replace(CAUGHT, alarms=0), BARE, "missed"),
        (replace(CAUGHT, success=False, result="collision"), BARE, "caught"),
        (replace(CAUGHT, success=False, result="collision"), LOST, "caught"),
        (CAUGHT, replace(LOST, injection="not_reached"), "caught"),
    ],
)
def test_recovered_is_a_flight_that_is_nearer_its_twin_than_without_the_detector(
    flight: Result, bare: Result, expected: str
) -> None:
    assert effect(flight, bare) == expected


def test_a_campaign_counts_them_by_cell_beside_the_same_run_of_the_arm_without_a_detector() -> None:
    cells = [Cell(arm, "sparse", "pid") for arm in ("bare", "watched", "blind")]

    def flown(arm: str, number: int, one: Result) -> FlightRecord:
        return FlightRecord(Cell(arm, "sparse", "pid"), number, number, "done", 1, "", one, number)

    records = [
        *(flown("bare", 0, BARE), flown("bare", 1, replace(BARE, flight_time_s=20.0))),
        *(flown("watched", 0, CAUGHT), flown("watched", 1, CAUGHT), flown("watched", 2, CAUGHT)),
        *(flown("blind", 0, STRUCK), flown("blind", 1, STRUCK)),
    ]
    bare, watched, blind = summarise(cells, of_records(cells, records), {"watched": "bare", "blind": "bare"})
    assert bare.effects == {}
    assert watched.effects == {"unaffected": 0, "missed": 0, "caught": 2, "recovered": 1}
    assert blind.effects == {"unaffected": 0, "missed": 2, "caught": 0, "recovered": 0}


def test_an_arms_reference_differs_from_it_by_the_detector_alone() -> None:
    watch = {"detector": {"scheme": "gaussian"}}
    arms = (
        Arm(name="bare"),
        Arm(name="watched", mission=watch),
        Arm(name="other planner, watched", mission={"planner": "rrt", **watch}),
        Arm(name="another planner", mission={"planner": "prm_star"}),
    )
    faults = (Condition(name="pid", fault=FaultSpec(target="pid")),)
    assert unprotected_arms(CampaignSpec(name="x", runs=2, arms=arms, faults=faults)) == {"watched": "bare"}


def test_an_arm_with_another_fault_is_no_reference() -> None:
    fault, other = FaultSpec(target="pid"), FaultSpec(target="octomap")
    watched = Arm(name="watched", mission={"detector": {"scheme": "gaussian"}}, fault=fault)
    for bare, expected in ((fault, {"watched": "bare"}), (other, {})):
        arms = (Arm(name="bare", fault=bare), watched)
        assert unprotected_arms(CampaignSpec(name="x", runs=2, arms=arms)) == expected
