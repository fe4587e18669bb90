"""The application: its paths, its document, its life."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Any

from fastapi import APIRouter, FastAPI
from prometheus_client import CollectorRegistry

from dashboard.api import problems
from dashboard.api.problems import documented
from dashboard.api.request_limit import RequestLimit
from dashboard.api.routes import (
    campaigns,
    catalogue,
    flights,
    health,
    metrics,
    nodes,
    program_studies,
    recordings,
    results,
    runs,
    streaming,
)
from dashboard.api.security import AccessGuard, BodyLimit, UserOf
from dashboard.api.service import Service
from services.system.peers import peer_uid

MOST_BODY_BYTES = 2_000_000
"""A campaign with worlds of its own takes some 100 kB."""

EVERYWHERE = documented(400, 401, 403, 429, 500, 503)


def make_app(
    service: Service, token: str = "", *, loopback: bool = True, user_of: UserOf = peer_uid
) -> FastAPI:
    """The service as an ASGI application.

    ``token`` is the hash of what requests must bear; ``loopback`` and ``user_of``: see :class:`AccessGuard`.
    """

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        service.event_bus.bind(asyncio.get_running_loop())
        yield
        service.event_bus.close()

    app = _Documented(
        title="ZenFI",
        version=version("zenfi"),
        summary="What one flipped bit does to the mission",
        lifespan=life,
        openapi_url="/api/v1/openapi.json",
        docs_url="/api/v1/docs",
        redoc_url=None,
    )
    app.state.service, app.state.token = service, token
    api = APIRouter(prefix="/api/v1", responses=EVERYWHERE)
    for part in (
        *(streaming, runs, recordings, results, campaigns),
        *(flights, program_studies, catalogue, nodes, health),
    ):
        api.include_router(part.router)
    app.include_router(api)
    app.include_router(health.for_all, responses=EVERYWHERE)
    app.include_router(metrics.router, responses=EVERYWHERE)
    problems.install(app)
    app.state.metrics = CollectorRegistry()
    app.state.metrics.register(metrics.ServiceMetrics(service))
    app.add_middleware(BodyLimit, most=MOST_BODY_BYTES)
    app.add_middleware(RequestLimit)
    app.add_middleware(AccessGuard, token=token, loopback=loopback, user_of=user_of)
    app.add_middleware(metrics.Observed, registry=app.state.metrics)
    return app


class _Documented(FastAPI):
    def openapi(self) -> dict[str, Any]:
        """The document; problems have a media type of their own."""
        if self.openapi_schema is None:
            document = super().openapi()
            for path in document["paths"].values():
                for operation in path.values():
                    for status, response in operation["responses"].items():
                        if int(status) >= 400:
                            problem = {"schema": {"$ref": "#/components/schemas/Problem"}}
                            response["content"] = {problems.MEDIA_TYPE: problem}
        assert self.openapi_schema is not None  # noqa: S101 - just made
        return self.openapi_schema
