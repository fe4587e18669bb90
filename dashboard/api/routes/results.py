"""What a campaign has found: tables with intervals, rows for other programs, files."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Query
from fastapi.responses import FileResponse, Response
from starlette.background import BackgroundTask

from dashboard.api.problems import NotFoundError, documented
from dashboard.api.service import CampaignDep, ServiceDep
from dashboard.campaigns.results import export
from dashboard.campaigns.results.compare import Comparison, side_by_side
from dashboard.campaigns.results.summary import CellSummary, summary
from dashboard.campaigns.store.listing import Phase, line
from deploy.errors import BadSpecError
from services.models.base import Strict

router = APIRouter(prefix="/campaigns/{label}", tags=["results"], responses=documented(404, 422))

_MEDIA = {"csv": "text/csv", "parquet": "application/vnd.apache.parquet"}
_FILES = {media: {"schema": {"type": "string", "format": "binary"}} for media in _MEDIA.values()}


class CampaignTable(Strict):
    """What a campaign has found so far, a line per cell."""

    campaign: str
    phase: Phase
    summary: list[CellSummary]


class CampaignComparison(Strict):
    """Each cell beside its reference; empty if no two flights are of the same cell and seed."""

    campaign: str
    comparison: list[Comparison]


@router.get("/table", response_model=CampaignTable, responses={200: {"content": _FILES}})
def read_table(
    service: ServiceDep,
    campaign: CampaignDep,
    form: Annotated[Literal["json", "csv", "parquet"], Query(alias="format")] = "json",
) -> CampaignTable | Response:
    """Quality of flight per cell, with 95 % Wilson intervals of success."""
    lines = summary(service.store, campaign)
    if form == "json":
        phase = line(service.store, campaign).phase
        return CampaignTable(campaign=campaign.label, phase=phase, summary=lines)
    return _file(f"{campaign.label}-table.{form}", lambda path: export.write_summary(lines, path))


@router.get("/export", response_class=Response, responses={200: {"content": _FILES}})
def export_runs(
    service: ServiceDep,
    campaign: CampaignDep,
    form: Annotated[Literal["csv", "parquet"], Query(alias="format")] = "csv",
) -> Response:
    """A row per run, with its result if it has one."""
    return _file(f"{campaign.label}.{form}", lambda path: export.write(service.store.records(campaign), path))


@router.get("/comparison")
def read_comparison(
    service: ServiceDep,
    campaign: CampaignDep,
    other: Annotated[str | None, Query(description="label of another campaign")] = None,
    against: Annotated[str | None, Query(description="arm of this campaign")] = None,
) -> CampaignComparison:
    """Each cell beside its golden twins, the arm ``against``, or the cell of its name in ``other``."""
    if other is not None and against is not None:
        raise BadSpecError("other, against: at most one of them")
    another = service.store.find(other) if other is not None else None
    compared = side_by_side(service.store, campaign, another, against)
    return CampaignComparison(campaign=campaign.label, comparison=compared)


def _file(name: str, write: Callable[[Path], None]) -> Response:
    """A file written for this request alone."""
    folder = Path(tempfile.mkdtemp(prefix="zenfi-export-"))
    remove = BackgroundTask(shutil.rmtree, folder, ignore_errors=True)
    path = folder / name
    try:
        write(path)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return FileResponse(path, media_type=_MEDIA[path.suffix[1:]], filename=name, background=remove)


class Artefact(Strict):
    """A file of a campaign, with its size."""

    path: str
    bytes: int


@router.get("/artefacts", tags=["artefacts"])
def list_artefacts(service: ServiceDep, campaign: CampaignDep) -> list[Artefact]:
    """The files of a campaign: what its workers printed, recordings."""
    folder = service.store.artefacts(campaign)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return [Artefact(path=str(path.relative_to(folder)), bytes=path.stat().st_size) for path in files]


@router.get(
    "/artefacts/{path:path}",
    tags=["artefacts"],
    response_class=FileResponse,
    responses={
        200: {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}},
        206: {"description": "the asked ranges", "content": {"application/octet-stream": {}}},
        **documented(416),
    },
)
def read_artefact(service: ServiceDep, campaign: CampaignDep, path: str) -> Response:
    """A file of a campaign, or the ranges of it that the header ``Range`` asks for."""
    folder = service.store.artefacts(campaign)
    if path not in {one.path for one in list_artefacts(service, campaign)}:
        message = f"{campaign.label} has no file {path!r}"
        raise NotFoundError(message)
    return FileResponse(folder / path, media_type="application/octet-stream")
