"""A single flight, a fault by hand while it flies, and both flown again."""

from typing import Any

import pytest

from dashboard.api.routes.flights import FlightInfo
from dashboard.campaigns.store.listing import run_page
from dashboard.campaigns.store.store import Store
from dashboard.client import Client, RequestRefusedError
from deploy.pairing.replay import Replay
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from tests.dashboard.api.asking import ask, make
from tests.dashboard.campaigns.store.test_store import flown

MISSION = MissionSpec(limits=Limits(mission_time_s=6))
LONG = MissionSpec(mission="scanning", limits=Limits(mission_time_s=16))
"""Under way for seconds on its watch: virtual seconds go by ten times as fast."""

LASTING = FaultSpec(level="source", target="command.vx", recurrence="permanent", bit_numbers=(62,))


def test_a_flight_that_ends_while_it_is_read_has_not_ended_without_its_result(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = make(store)
    label = ask(app, "/api/v1/flights", "POST", json={"mission": {}}).json()["campaign"]["campaign"]

    def end_once_read(*of: Any) -> Any:
        found = run_page(*of)
        flown(store, store.find(label), 1)
        return found

    with monkeypatch.context() as patched:
        patched.setattr("dashboard.api.routes.flights.run_page", end_once_read)
        told = ask(app, f"/api/v1/flights/{label}").json()
    assert told["campaign"]["phase"] != "done" or told["run"]["result"] is not None
    assert ask(app, f"/api/v1/flights/{label}").json()["campaign"]["phase"] == "done"


@pytest.mark.soak
def test_a_flight_is_struck_by_hand_after_the_moment_it_was_asked_for(client: Client) -> None:
    watched = client.flights.create(LONG).campaign.campaign
    struck: FlightInfo | None = None
    for event in client.watch(watched):
        if event.kind == "flight" and event.data.present.time_s > 1 and struck is None:
            struck = client.flights.inject(watched, FaultSpec(target="pid", seed=3))
            lasting = client.flights.inject(watched, LASTING).campaign.campaign
    assert struck is not None
    fault = client.campaigns.get(lasting).spec.arms[0].fault
    assert fault is not None
    assert fault.from_s > 1, "it recurs from now on"
    client.campaigns.command(lasting, "cancel")
    assert list(client.watch(struck.campaign.campaign))[-1].data.phase == "done"

    golden = client.runs.outcome(watched, client.flights.get(watched).run.id)
    outcome = client.runs.outcome(struck.campaign.campaign, struck.run.id)
    assert outcome.injection is not None
    assert outcome.injection.status == "injected"
    assert outcome.injection.precision == "exact"
    assert outcome.injection.virtual_time_ns > 1e9
    assert outcome.golden is not None
    assert outcome.golden.digest == golden.digest

    answer = client.runs.replay(struck.campaign.campaign, struck.run.id)
    assert answer == Replay(answer="replayed")
    run = client.flights.get(watched).run.id
    with pytest.raises(RequestRefusedError, match="POST here records one"):
        client.runs.series(watched, run)
    recorded = client.runs.record_series(watched, run)
    assert recorded.points[-1].qof == golden.qof
    assert client.runs.series(watched, run) == recorded

    with pytest.raises(RequestRefusedError, match="not under way") as refused:
        client.flights.inject(watched, FaultSpec(target="pid"))
    assert refused.value.problem.status == 409


@pytest.mark.soak
def test_nodes_and_processes_of_a_flight_are_shown(client: Client) -> None:
    watched = client.flights.create(
        MISSION.model_copy(update={"seed": 5, "clock": "realtime"})
    ).campaign.campaign
    seen: set[str] = set()
    for event in client.watch(watched):
        if event.kind == "flight" and not seen:
            seen = {node.name for node in client.nodes()}
            names = {process.name for process in client.processes().service}
    assert {"sim", "perception", "planning", "control"} <= seen
    assert "zenfi-sim" in names


def test_a_flight_that_cannot_be_flown_is_refused(client: Client) -> None:
    with pytest.raises(RequestRefusedError, match="unknown planner 'best'"):
        client.flights.create(MissionSpec(planner="best"))
