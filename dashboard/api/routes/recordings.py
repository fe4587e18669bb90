"""The recordings of a run and of its golden twin: where they lie, and how they are made afterwards."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from fastapi import APIRouter
from fastapi.responses import FileResponse

from dashboard.api.problems import NotFoundError, documented
from dashboard.api.processes.rerun_process import RecordedFlight, rerun
from dashboard.api.routes.runs import RunId, repeatable
from dashboard.api.service import CampaignDep, Service, ServiceDep
from dashboard.campaigns.store.queries import CampaignEntry

MEDIA_TYPE = "application/vnd.mcap"

router = APIRouter(prefix="/campaigns/{label}/runs", tags=["runs"], responses=documented(404, 422))


class Recordings(NamedTuple):
    """Where recordings lie, or would. A run without a fault has no twin: its own is one."""

    flight: Path
    twin: Path

    @property
    def complete(self) -> bool:
        """Whether both recordings exist."""
        return self.flight.is_file() and self.twin.is_file()


def recordings(service: Service, campaign: CampaignEntry, run: int) -> Recordings:
    """The paths of the recordings of a run and its twin."""
    folder = service.store.artefacts(campaign)
    return Recordings(folder / f"run-{run}.mcap", folder / f"run-{run}.golden.mcap")


@router.post("/{run}/recording", status_code=201, responses=documented(409))
def record_run(service: ServiceDep, campaign: CampaignDep, run: RunId) -> RecordedFlight:
    """Fly a run again, and the golden twin of an injected one, and keep both as MCAP."""
    told = rerun(repeatable(service, campaign, run), "record", *map(str, recordings(service, campaign, run)))
    return RecordedFlight.model_validate_json(told)


@router.get(
    "/{run}/recording",
    response_class=FileResponse,
    responses={200: {"content": {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}}},
)
def read_recording(
    service: ServiceDep, campaign: CampaignDep, run: RunId, *, twin: bool = False
) -> FileResponse:
    """A run's recording, or its golden twin's, as MCAP."""
    kept = recordings(service, campaign, run)
    path = kept.twin if twin else kept.flight
    if not path.is_file():
        message = f"run {run} of {campaign.label} has no recording yet; POST here records one"
        raise NotFoundError(message)
    return FileResponse(path, media_type=MEDIA_TYPE, filename=f"{campaign.label}-{path.name}")
