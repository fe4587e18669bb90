"""What every endpoint needs: the store, the event_bus, the runners."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from dashboard.api.processes.campaign_runner import CampaignRunner
from dashboard.api.processes.event_bus import EventBus
from dashboard.api.processes.program_runner import ProgramRunner
from dashboard.api.processes.study_reader import StudyReaders
from dashboard.api.programs import Programs
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store


@dataclass(frozen=True, slots=True)
class Service:
    """One life of the service; ``programs`` are those that may be asked for as stages of a flight."""

    store: Store
    event_bus: EventBus
    runner: CampaignRunner
    program_studies: ProgramRunner
    programs: Programs = frozenset()
    study_readers: StudyReaders = field(default_factory=StudyReaders)


def _service(connection: HTTPConnection) -> Service:
    service: Service = connection.app.state.service
    return service


ServiceDep = Annotated[Service, Depends(_service)]


def _campaign(label: str, service: ServiceDep) -> CampaignEntry:
    return service.store.find(label)


CampaignDep = Annotated[CampaignEntry, Depends(_campaign)]
"""The campaign that the path names by its label or number."""
