"""How the service is: for machines that watch it, and for its owner."""

import os
from pathlib import Path

import httpx
import pytest

from dashboard.api.app import make_app
from dashboard.api.processes.campaign_runner import CampaignRunner
from dashboard.api.processes.event_bus import EventBus
from dashboard.api.routes.health import ServiceState
from dashboard.api.service import Service
from dashboard.campaigns.store.store import Store
from dashboard.client import Client
from services.models.mission import Limits, MissionSpec
from tests.conftest import wait_until
from tests.dashboard.api.asking import ask, make, waiting
from tests.dashboard.api.conftest import PATIENCE_S, Serving

STATE = "/api/v1/state"


def state(service: Serving) -> ServiceState:
    return ServiceState.model_validate_json(httpx.get(f"{service.address}{STATE}").content)


def test_it_tells_lanes_store_and_the_last_flight(service: Serving, client: Client) -> None:
    label = client.flights.create(MissionSpec(limits=Limits(mission_time_s=0.6))).campaign.campaign
    for _ in client.watch(label):
        pass
    # Its process ends a moment after its result is told.
    wait_until(lambda: not any(lane.flying for lane in state(service).lanes), PATIENCE_S)
    told = state(service)
    assert told.trouble == ""
    assert [(lane.name, lane.alive, lane.failures) for lane in told.lanes] == [
        ("campaigns", True, 0),
        ("flights", True, 0),
        ("programs", True, 0),
    ]
    assert told.last_flight is not None
    assert told.last_flight.campaign == label
    found = Path(told.store.place).stat()
    assert told.store.file == (found.st_dev, found.st_ino)
    assert told.store.free_mb > 0


def test_others_are_told_nothing_but_whether_it_works(store: Store) -> None:
    app = make(store, uid=os.getuid() + 1)
    assert ask(app, "/health").json() == {"status": "ok"}
    assert ask(app, STATE).status_code == 401


def test_without_room_for_results_it_takes_none(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    event_bus = EventBus()
    runner = CampaignRunner(store, event_bus, 1)
    service = Service(store, event_bus, runner, waiting(store, event_bus))
    app = make_app(service, user_of=lambda _peer, _ours: os.getuid())
    runner.start()
    try:
        assert ask(app, "/ready").status_code == 200
        monkeypatch.setattr("dashboard.api.routes.health.LEAST_FREE_MB", 10**12)
        refused = ask(app, "/ready")
        assert refused.status_code == 503
        assert str(store.folder) not in refused.text
        assert "MB are left on its disk" in ask(app, STATE).json()["trouble"]
        store.folder.rename(store.folder.with_name("away"))
        told = ServiceState.model_validate_json(ask(app, STATE).content)
        assert told.trouble
        assert told.store.free_mb == 0
        store.folder.with_name("away").rename(store.folder)
    finally:
        runner.stop()
