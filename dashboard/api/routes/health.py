"""Whether the service works, for machines that watch it, and how it is, for its owner."""

from __future__ import annotations

import shutil

import sqlalchemy as sa
from fastapi import APIRouter
from pydantic import Field

from dashboard.api.problems import NotReadyError, documented
from dashboard.api.processes.campaign_runner import FlownRun, LaneState
from dashboard.api.service import Service, ServiceDep
from dashboard.campaigns.store.database import REVISION, StoreError
from services.models.base import Strict

LEAST_FREE_MB = 50
"""Room on the store's disk below which no campaign is taken: its first flights would not be kept."""

for_all = APIRouter(tags=["operations"])
"""What is told to everybody: nothing but that it works."""

router = APIRouter(tags=["operations"])


class Status(Strict):
    """The state of the service: `ok` if it works."""

    status: str = "ok"


class StoreState(Strict):
    """Where the store is, which file of which disk it is, and the form of its tables."""

    place: str
    file: tuple[int, int] | None = Field(description="device and inode; null of a database server")
    form: str
    free_mb: int = Field(description="room left on the disk of the store's folder")


class ServiceState(Strict):
    """How the service is; ``trouble`` is empty if it takes campaigns."""

    trouble: str
    lanes: list[LaneState]
    store: StoreState
    given_up: dict[str, str] = Field(description="campaigns that wait for `resume`, and why")
    last_flight: FlownRun | None = Field(description="in this life of the service")


@for_all.get("/health")
def read_health() -> Status:
    """Whether the service answers at all."""
    return Status()


@for_all.get("/ready", responses=documented(503))
def read_ready(service: ServiceDep) -> Status:
    """Whether it can take campaigns: the store answers and has room, and somebody flies what is in it."""
    if _trouble(service):
        raise NotReadyError("no campaign can be taken: /api/v1/state tells its owner why")
    return Status()


@router.get("/state")
def read_state(service: ServiceDep) -> ServiceState:
    """How the service is: its lanes, its store, the last flight."""
    store, runner = service.store, service.runner
    return ServiceState(
        trouble=_trouble(service),
        lanes=[*runner.lanes, service.program_studies.state],
        store=StoreState(
            place=store.place, file=store.database.file, form=REVISION, free_mb=_free_mb(service)
        ),
        given_up=dict(runner.given_up),
        last_flight=runner.last_flight,
    )


def _trouble(service: Service) -> str:
    """Why no campaign can be taken; empty if one can."""
    if service.event_bus.closed or not service.runner.working:
        return "the service is starting, or ending"
    try:
        with service.store.reading() as connection:
            connection.execute(sa.select(sa.literal(1)))
    except StoreError as error:
        return str(error)
    if (free := _free_mb(service)) < LEAST_FREE_MB:
        return f"{service.store.folder}: {free} MB are left on its disk, at least {LEAST_FREE_MB} are needed"
    return ""


def _free_mb(service: Service) -> int:
    try:
        return shutil.disk_usage(service.store.folder).free // 1_000_000
    except OSError:  # the folder is gone
        return 0
