"""A service that flies nothing, asked in this process."""

import asyncio
import os
from collections.abc import Mapping
from typing import Any

import httpx
from fastapi import FastAPI

from dashboard.api.app import make_app
from dashboard.api.processes.campaign_runner import CampaignRunner
from dashboard.api.processes.event_bus import EventBus
from dashboard.api.processes.program_runner import ProgramRunner
from dashboard.api.processes.program_studies import FOLDER, ProgramStudies
from dashboard.api.service import Service
from dashboard.campaigns.store.store import Store
from deploy.kernel_study.program_study import ProgramStudySpec

HERE = "http://localhost:8300"
CAMPAIGNS = "/api/v1/campaigns"


def make(
    store: Store,
    token: str = "",
    *,
    loopback: bool = True,
    uid: int | None = os.getuid(),
    allowed: Mapping[str, ProgramStudySpec] | None = None,
) -> FastAPI:
    """Campaigns and studies wait; streams end when they have told all. Who asks is the user ``uid``."""
    event_bus = EventBus()
    event_bus.close()
    studies = waiting(store, event_bus, allowed)
    service = Service(store, event_bus, CampaignRunner(store, event_bus, 1), studies)
    return make_app(service, token, loopback=loopback, user_of=lambda _peer, _ours: uid)


def waiting(
    store: Store, event_bus: EventBus, allowed: Mapping[str, ProgramStudySpec] | None = None
) -> ProgramRunner:
    """The studies of a store, which wait as long as nobody starts the runner."""
    return ProgramRunner(ProgramStudies(store.folder / FOLDER, allowed or {}), event_bus, 1)


def ask(app: FastAPI, path: str, method: str = "GET", base: str = HERE, **request: Any) -> httpx.Response:
    async def answer() -> httpx.Response:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url=base) as client:
            return await client.request(method, path, **request)

    return asyncio.run(answer())
