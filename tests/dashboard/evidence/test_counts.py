"""Which runs stand for an element, and what each of them counts as."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.spec import Arm, CampaignSpec, Cell
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.evidence.budget import Element, Stated
from dashboard.evidence.counts import strikes_of
from dashboard.evidence.ledger import StrikeCounts
from deploy.errors import BadSpecError
from tests.dashboard.campaigns.test_flight_record import result

ONE = Stated(value=1.0, source="by hand")
BENIGN = replace(result(injection="injected"), digest="twin")
WRONG = replace(result(injection="injected"), digest="own")
HARMED = replace(result(injection="injected", success=False, harm="mission_lost"), digest="own")
CELL = Cell("bare", "sparse", "pid")


def element(**names: str) -> Element:
    return Element(name="control", fit=ONE, flux=ONE, share=ONE, **names)


def campaign(number: int) -> CampaignEntry:
    spec = CampaignSpec(name="flown", runs=9, arms=(Arm(name="bare"),))
    return CampaignEntry(number, spec, "done", "", "")


def runs(*results: Result | None, cell: Cell = CELL) -> Sequence[FlightRecord]:
    return [
        FlightRecord(cell, number, number, "done" if one is not None else "failed", 1, "", one, number)
        for number, one in enumerate(results)
    ]


def test_strikes_are_counted_by_what_came_of_them_and_the_rest_is_told() -> None:
    missed = replace(BENIGN, injection="not_reached")
    unjudged = replace(WRONG, harm=None)
    flown = [(campaign(1), runs(BENIGN, WRONG, HARMED, missed, unjudged, None, BENIGN))]
    found = strikes_of(element(), flown)
    assert found.counts == StrikeCounts(struck=4, manifested=2, harmed=1)
    assert (found.not_injected, found.failed, found.not_judged) == (1, 1, 1)
    assert [one.run.number for one in found.harmful] == [2]


def test_a_flight_that_ended_otherwise_than_its_twin_has_manifested() -> None:
    lost = replace(BENIGN, result="stack_failure", success=False)
    assert strikes_of(element(), [(campaign(1), runs(lost, BENIGN))]).counts == (2, 1, 0)


def test_harm_that_no_message_shows_has_manifested() -> None:
    silent = replace(HARMED, result="success", digest="twin")
    assert strikes_of(element(), [(campaign(1), runs(silent))]).counts == (1, 1, 1)


def test_worlds_are_taken_together_and_arms_faults_and_campaigns_are_not() -> None:
    dense = runs(HARMED, cell=CELL._replace(world="dense"))
    assert strikes_of(element(), [(campaign(1), [*runs(BENIGN), *dense])]).counts.struck == 2
    assert strikes_of(element(world="dense"), [(campaign(1), [*runs(BENIGN), *dense])]).counts == (1, 1, 1)
    for other in ({"arm": "watched"}, {"fault": "octomap"}):
        several = [*runs(BENIGN), *runs(BENIGN, cell=CELL._replace(**other))]
        with pytest.raises(BadSpecError, match=f"name one of .*{next(iter(other.values()))}"):
            strikes_of(element(), [(campaign(1), several)])
    twice = [(campaign(1), runs(BENIGN)), (campaign(2), runs(HARMED))]
    with pytest.raises(BadSpecError, match="flown-1/bare/pid, flown-2/bare/pid"):
        strikes_of(element(), twice)
    assert strikes_of(element(campaign="flown-2"), twice).counts == (1, 1, 1)


def test_a_cell_that_is_not_there_is_told_with_those_that_are() -> None:
    with pytest.raises(BadSpecError, match=r"fault='pdi'.*no such cell; there are .*pid"):
        strikes_of(element(fault="pdi"), [(campaign(1), runs(BENIGN))])
