"""Streams of what happens: server-sent events, and the same over a WebSocket."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Iterator
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, WebSocket
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import EventSourceResponse, ServerSentEvent
from starlette.websockets import WebSocketDisconnect

from dashboard.api.events import LostEvent
from dashboard.api.hub import Event, Hub
from dashboard.api.problems import documented
from dashboard.api.service import Here, Service
from dashboard.campaigns.listing import line
from dashboard.campaigns.steering import ENDED
from dashboard.campaigns.store import UnknownCampaignError
from deploy.check import BadSpecError

router = APIRouter(tags=["streams"])

LastEventId = Annotated[str | None, Header(alias="Last-Event-ID", max_length=100)]
After = Annotated[str | None, Query(max_length=100, description="what Last-Event-ID says, for who cannot")]


async def _label(here: Here, label: str) -> str:
    return (await run_in_threadpool(here.store.find, label)).label


Label = Annotated[str, Depends(_label)]


@router.get("/events", response_class=EventSourceResponse, responses=documented(422))
async def stream_everything(
    here: Here, last_event_id: LastEventId = None, after: After = None
) -> AsyncIterator[ServerSentEvent]:
    """What happens in all campaigns: kinds `campaign`, `run`, `flight`, `process`, `lost`.

    A client that comes back with Last-Event-ID gets what it has missed. What is gone is counted in
    `lost`; then, as at the first visit, comes the newest of everything that goes on.
    """
    async for event in _catch_up_and_follow(here.hub, last_event_id or after, ""):
        yield _sse(here.hub, event)


@router.get("/campaigns/{label}/events", response_class=EventSourceResponse, responses=documented(404, 422))
async def stream_campaign(
    here: Here, label: Label, last_event_id: LastEventId = None, after: After = None
) -> AsyncIterator[ServerSentEvent]:
    """What happens in one campaign, beginning with where it stands; ends when the campaign has ended."""
    async for event in _campaign(here, label, last_event_id or after):
        yield _sse(here.hub, event)


@router.websocket("/ws")
async def stream_to_websocket(socket: WebSocket, here: Here) -> None:
    """The same streams, a JSON object ``{id, event, data}`` a message; query: ``campaign``, ``after``."""
    label, after = socket.query_params.get("campaign", ""), socket.query_params.get("after")
    if label:
        try:
            label = await _label(here, label)
        except (UnknownCampaignError, BadSpecError) as error:
            await socket.close(4404, str(error)[:120])
            return
    await socket.accept()
    try:
        events = _campaign(here, label, after) if label else _catch_up_and_follow(here.hub, after, "")
        async for event in events:
            told = {"id": here.hub.identity(event.number), "event": event.kind}
            await socket.send_text(f'{json.dumps(told)[:-1]}, "data": {event.data}}}')
        await socket.close(1001 if here.hub.closed else 1000)
    except WebSocketDisconnect:
        return


async def _campaign(here: Service, label: str, seen: str | None) -> AsyncIterator[Event]:
    """Where a campaign stands, as the store says, then what happens in it."""
    now = here.hub.last
    found = await run_in_threadpool(lambda: line(here.store, here.store.find(label)))
    place = here.hub.place(seen)
    if place is None:
        yield Event(now, "campaign", found.model_dump_json(), label)
    if found.phase in ENDED and (place is None or place >= now):
        return
    async for event in _catch_up_and_follow(here.hub, seen, label):
        if place is None and event.kind == "campaign" and event.number <= now:
            continue  # the store knows better
        yield event
        if event.kind == "campaign" and json.loads(event.data)["phase"] in ENDED:
            return


async def _catch_up_and_follow(hub: Hub, seen: str | None, campaign: str) -> AsyncIterator[Event]:
    place = hub.place(seen)
    if place is None:
        if seen is not None:
            yield Event(0, "lost", LostEvent(events=None).model_dump_json())
        place = hub.last
        for event in _newest(hub, campaign):
            yield event
    async for event in hub.follow(place, campaign):
        yield event
        if event.kind == "lost":
            for newest in _newest(hub, campaign, event.number):
                yield newest


def _newest(hub: Hub, campaign: str, below: int | None = None) -> Iterator[Event]:
    """The newest of everything that goes on, as far as it is not still to come."""
    return (event for event in hub.newest(campaign) if below is None or event.number <= below)


def _sse(hub: Hub, event: Event) -> ServerSentEvent:
    return ServerSentEvent(raw_data=event.data, event=event.kind, id=hub.identity(event.number))
