"""Streams of what happens: server-sent events, and the same over a WebSocket."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Iterator
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, WebSocket
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import EventSourceResponse, ServerSentEvent
from starlette.websockets import WebSocketDisconnect

from dashboard.api.problems import documented
from dashboard.api.processes.event_bus import BusEvent, EventBus
from dashboard.api.processes.events import LostEvent
from dashboard.api.service import Service, ServiceDep
from dashboard.campaigns.commands import ENDED
from dashboard.campaigns.store.listing import line
from dashboard.campaigns.store.queries import UnknownCampaignError
from deploy.errors import BadSpecError

router = APIRouter(tags=["streams"])

LastEventId = Annotated[str | None, Header(alias="Last-Event-ID", max_length=100)]
After = Annotated[str | None, Query(max_length=100, description="what Last-Event-ID says, for who cannot")]


async def _label(service: ServiceDep, label: str) -> str:
    return (await run_in_threadpool(service.store.find, label)).label


Label = Annotated[str, Depends(_label)]


@router.get("/events", response_class=EventSourceResponse, responses=documented(422))
async def stream_everything(
    service: ServiceDep, last_event_id: LastEventId = None, after: After = None
) -> AsyncIterator[ServerSentEvent]:
    """What happens in all campaigns: kinds `campaign`, `run`, `flight`, `process`, `lost`.

    A client that comes back with Last-Event-ID gets what it has missed. What is gone is counted in
    `lost`; then, as at the first visit, comes the newest of everything that goes on.
    """
    async for event in _catch_up_and_follow(service.event_bus, last_event_id or after, ""):
        yield _sse(service.event_bus, event)


@router.get("/campaigns/{label}/events", response_class=EventSourceResponse, responses=documented(404, 422))
async def stream_campaign(
    service: ServiceDep, label: Label, last_event_id: LastEventId = None, after: After = None
) -> AsyncIterator[ServerSentEvent]:
    """What happens in one campaign, beginning with where it stands; ends when the campaign has ended."""
    async for event in _campaign(service, label, last_event_id or after):
        yield _sse(service.event_bus, event)


@router.websocket("/ws")
async def stream_to_websocket(socket: WebSocket, service: ServiceDep) -> None:
    """The same streams, a JSON object ``{id, event, data}`` a message; query: ``campaign``, ``after``."""
    label, after = socket.query_params.get("campaign", ""), socket.query_params.get("after")
    if label:
        try:
            label = await _label(service, label)
        except (UnknownCampaignError, BadSpecError) as error:
            await socket.close(4404, str(error)[:120])
            return
    await socket.accept()
    try:
        events = (
            _campaign(service, label, after) if label else _catch_up_and_follow(service.event_bus, after, "")
        )
        async for event in events:
            told = {"id": service.event_bus.identity(event.number), "event": event.kind}
            await socket.send_text(f'{json.dumps(told)[:-1]}, "data": {event.data}}}')
        await socket.close(1001 if service.event_bus.closed else 1000)
    except WebSocketDisconnect:
        return


async def _campaign(service: Service, label: str, seen: str | None) -> AsyncIterator[BusEvent]:
    """Where a campaign stands, as the store says, then what happens in it."""
    now = service.event_bus.last
    found = await run_in_threadpool(lambda: line(service.store, service.store.find(label)))
    place = service.event_bus.place(seen)
    if place is None:
        yield BusEvent(now, "campaign", found.model_dump_json(), label)
    if found.phase in ENDED and (place is None or place >= now):
        return
    async for event in _catch_up_and_follow(service.event_bus, seen, label):
        if place is None and event.kind == "campaign" and event.number <= now:
            continue  # the store knows better
        yield event
        if event.kind == "campaign" and json.loads(event.data)["phase"] in ENDED:
            return


async def _catch_up_and_follow(
    event_bus: EventBus, seen: str | None, campaign: str
) -> AsyncIterator[BusEvent]:
    place = event_bus.place(seen)
    if place is None:
        if seen is not None:
            yield BusEvent(0, "lost", LostEvent(events=None).model_dump_json())
        place = event_bus.last
        for event in _newest(event_bus, campaign):
            yield event
    async for event in event_bus.follow(place, campaign):
        yield event
        if event.kind == "lost":
            for newest in _newest(event_bus, campaign, event.number):
                yield newest


def _newest(event_bus: EventBus, campaign: str, below: int | None = None) -> Iterator[BusEvent]:
    """The newest of everything that goes on, as far as it is not still to come."""
    return (event for event in event_bus.newest(campaign) if below is None or event.number <= below)


def _sse(event_bus: EventBus, event: BusEvent) -> ServerSentEvent:
    return ServerSentEvent(raw_data=event.data, event=event.kind, id=event_bus.identity(event.number))
