"""The recordings of a run and of its golden twin: where they lie, and how they are made afterwards."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from fastapi import APIRouter
from fastapi.responses import FileResponse

from dashboard.api.again import Recorded, again
from dashboard.api.problems import NotFoundError, documented
from dashboard.api.runs import RunId, repeatable
from dashboard.api.service import Found, Here, Service
from dashboard.campaigns.store import Campaign

MEDIA_TYPE = "application/vnd.mcap"

router = APIRouter(prefix="/campaigns/{label}/runs", tags=["runs"], responses=documented(404, 422))


class Recordings(NamedTuple):
    """Where recordings lie, or would. A run without a fault has no twin: its own is one."""

    flight: Path
    twin: Path

    @property
    def complete(self) -> bool:
        """Whether both are there."""
        return self.flight.is_file() and self.twin.is_file()


def recordings(here: Service, found: Campaign, run: int) -> Recordings:
    """Where those of a run are."""
    folder = here.store.artefacts(found)
    return Recordings(folder / f"run-{run}.mcap", folder / f"run-{run}.golden.mcap")


@router.post("/{run}/recording", status_code=201, responses=documented(409))
def record_run(here: Here, found: Found, run: RunId) -> Recorded:
    """Fly a run again, and the golden twin of an injected one, and keep both as MCAP."""
    told = again(repeatable(here, found, run), "record", *map(str, recordings(here, found, run)))
    return Recorded.model_validate_json(told)


@router.get(
    "/{run}/recording",
    response_class=FileResponse,
    responses={200: {"content": {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}}},
)
def read_recording(here: Here, found: Found, run: RunId, *, twin: bool = False) -> FileResponse:
    """A run's recording, or its golden twin's, as MCAP."""
    kept = recordings(here, found, run)
    path = kept.twin if twin else kept.flight
    if not path.is_file():
        message = f"run {run} of {found.label} has no recording yet; POST here records one"
        raise NotFoundError(message)
    return FileResponse(path, media_type=MEDIA_TYPE, filename=f"{found.label}-{path.name}")
