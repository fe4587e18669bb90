"""Streams as a client reads them: where it stands first, then what it has missed."""

import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from dashboard.api.processes.event_bus import EventBus
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.store import Store
from tests.dashboard.api.asking import CAMPAIGNS, ask, make


@pytest.fixture
def app(tmp_path: Path) -> Iterator[FastAPI]:
    """With two campaigns, of which the first has got on; its streams end where they would wait."""
    with closing(Store(tmp_path)) as store:
        for name in ("x", "y"):
            store.create(CampaignSpec(name=name, runs=1, arms=(Arm(name="a"),)))
        app = make(store)
        event_bus: EventBus = app.state.service.event_bus
        for run in (1, 2, 3):
            event_bus.publish("flight", json.dumps({"run": run}), "x-1", f"flight {run}")
            event_bus.publish("run", json.dumps({"run": run}), "x-1")
        event_bus.forget("flight 1")
        event_bus.forget("flight 2")
        event_bus.publish("run", json.dumps({"run": 4}), "y-2")
        yield app


def read(app: FastAPI, path: str, last: str | None = None) -> list[tuple[str, Any, str]]:
    """Kind, data and identity of every event."""
    answer = ask(app, path, headers={"Last-Event-ID": last} if last is not None else {})
    assert answer.headers["content-type"].startswith("text/event-stream")
    events = [
        dict(line.split(": ", 1) for line in event.split("\n"))
        for event in answer.text.split("\n\n")
        if event
    ]
    return [(event["event"], json.loads(event["data"]), event["id"]) for event in events]


def test_a_new_client_is_told_what_goes_on(app: FastAPI) -> None:
    assert [(kind, data["run"]) for kind, data, _ in read(app, "/api/v1/events")] == [("flight", 3)]


def test_a_campaign_s_stream_begins_with_where_it_stands(app: FastAPI) -> None:
    first, second = read(app, f"{CAMPAIGNS}/x-1/events")
    assert (first[0], first[1]["campaign"], first[1]["phase"]) == ("campaign", "x-1", "queued")
    assert second[:2] == ("flight", {"run": 3})


def test_a_client_that_comes_back_gets_what_it_has_missed(app: FastAPI) -> None:
    event_bus: EventBus = app.state.service.event_bus
    missed = read(app, "/api/v1/events", event_bus.identity(4))
    assert [(kind, data["run"]) for kind, data, _ in missed] == [("flight", 3), ("run", 3), ("run", 4)]
    assert [name for *_, name in missed] == [event_bus.identity(number) for number in (5, 6, 7)]
    ours = read(app, f"{CAMPAIGNS}/x-1/events", event_bus.identity(4))
    assert [(kind, data["run"]) for kind, data, _ in ours] == [("flight", 3), ("run", 3)]


def test_a_client_of_another_life_of_the_service_is_told_that_it_has_lost_some(app: FastAPI) -> None:
    lost, flight = read(app, "/api/v1/events", "18ea0000.7")
    assert lost[:2] == ("lost", {"events": None})
    assert flight[:2] == ("flight", {"run": 3})


def test_there_is_no_stream_of_no_campaign(app: FastAPI) -> None:
    assert ask(app, f"{CAMPAIGNS}/z-9/events").status_code == 404
