"""A service that flies nothing, asked in this process."""

import asyncio
from typing import Any

import httpx
from fastapi import FastAPI

from dashboard.api.app import make_app
from dashboard.api.processes.campaign_runner import CampaignRunner
from dashboard.api.processes.event_bus import EventBus
from dashboard.api.service import Service
from dashboard.campaigns.store.store import Store

HERE = "http://localhost:8300"
CAMPAIGNS = "/api/v1/campaigns"


def make(store: Store, token: str = "", *, loopback: bool = True) -> FastAPI:
    """Campaigns wait; streams end when they have told what there is."""
    event_bus = EventBus()
    event_bus.close()
    return make_app(Service(store, event_bus, CampaignRunner(store, event_bus, 1)), token, loopback=loopback)


def ask(app: FastAPI, path: str, method: str = "GET", base: str = HERE, **request: Any) -> httpx.Response:
    async def answer() -> httpx.Response:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url=base) as client:
            return await client.request(method, path, **request)

    return asyncio.run(answer())
