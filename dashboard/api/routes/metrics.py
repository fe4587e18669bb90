"""What the service counts and logs: metrics for Prometheus, a line of JSON for each request."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Iterator

import sqlalchemy as sa
from fastapi import APIRouter
from fastapi.responses import PlainTextResponse
from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dashboard.api.service import Service
from dashboard.campaigns.store.schema import CampaignRow, RunRow

_PLAIN = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "color_message", "taskName"}

router = APIRouter(tags=["operations"])
logger = logging.getLogger("zenfi.access")


class JsonFormatter(logging.Formatter):
    """One JSON object a line; what was given as ``extra`` are fields of it."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a log record as a line of JSON."""
        told = {
            "time": self.formatTime(record, "%Y-%m-%dT%H:%M:%S%z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **{name: value for name, value in record.__dict__.items() if name not in _PLAIN},
        }
        if record.exc_info:
            told["exception"] = self.formatException(record.exc_info)
        return json.dumps(told, default=str)


def log_to_stderr() -> None:
    """Have all that is logged written as lines of JSON."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    logging.basicConfig(level=logging.INFO, handlers=[handler])


@router.get("/metrics", response_class=PlainTextResponse)
def read_metrics(request: Request) -> PlainTextResponse:
    """Metrics in the text format of Prometheus."""
    return PlainTextResponse(generate_latest(request.app.state.metrics))


class ServiceMetrics(Collector):
    """What is counted when somebody asks."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        """Counts of campaigns, runs, stream clients and campaign processes."""
        event_bus, runner = self._service.event_bus, self._service.runner
        for name, row in (("campaigns", CampaignRow), ("runs", RunRow)):
            query = sa.select(row.phase, sa.func.count()).where(CampaignRow.deleted == "").group_by(row.phase)
            if row is RunRow:
                query = query.join(CampaignRow, CampaignRow.id == RunRow.campaign_id)
            family = GaugeMetricFamily(f"zenfi_{name}", f"{name} in the store", labels=["phase"])
            with self._service.store.reading() as connection:
                for phase, count in connection.execute(query):
                    family.add_metric([phase], count)
            yield family
        yield CounterMetricFamily("zenfi_events", "events published", value=event_bus.last)
        yield CounterMetricFamily(
            "zenfi_events_dropped", "events that a client came too late for", value=event_bus.dropped
        )
        yield GaugeMetricFamily("zenfi_stream_clients", "clients of streams", value=event_bus.watchers)
        yield GaugeMetricFamily("zenfi_pilots", "campaigns being flown", value=len(runner.processes))
        yield GaugeMetricFamily("zenfi_given_up", "campaigns given up", value=len(runner.given_up))


class Observed:
    """Counts and logs every request."""

    def __init__(self, app: ASGIApp, registry: CollectorRegistry) -> None:
        self._app = app
        self._requests = Counter(
            "zenfi_http_requests", "requests", ["method", "route", "status"], registry=registry
        )
        self._seconds = Histogram(
            "zenfi_http_seconds", "until the response begins", ["route"], registry=registry
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, then count and log it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begin = time.monotonic()

        async def told(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._note(scope, message["status"], time.monotonic() - begin)
            await send(message)

        await self._app(scope, receive, told)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        # A path as the client wrote it would make a metric of each.
        route = getattr(scope.get("route"), "path", "unknown")
        self._requests.labels(scope["method"], route, status).inc()
        self._seconds.labels(route).observe(seconds)
        extra = {
            "method": scope["method"],
            "path": scope["path"],
            "status": status,
            "ms": round(seconds * 1e3, 1),
        }
        logger.info("%s %s %d", scope["method"], scope["path"], status, extra=extra)
