"""REST resource ``/campaigns/LABEL/runs``: read, replay and record runs."""

from __future__ import annotations

from pathlib import Path as FilePath
from typing import Annotated

from fastapi import APIRouter, Path, Query

from dashboard.api.problems import NotFoundError, documented
from dashboard.api.processes.rerun_process import FlightSeries, rerun
from dashboard.api.service import CampaignDep, Service, ServiceDep
from dashboard.campaigns.store.listing import (
    LARGEST_ID,
    RunListing,
    RunQuery,
    StoredRun,
    run_page,
    stored_run,
)
from dashboard.campaigns.store.queries import CampaignEntry
from deploy.errors import BadSpecError
from deploy.pairing.replay import Replay
from services.models.outcome import InjectionRecord, Outcome

router = APIRouter(prefix="/campaigns/{label}/runs", tags=["runs"], responses=documented(404, 422))

RunId = Annotated[int, Path(ge=0, le=LARGEST_ID)]


@router.get("")
def list_runs(service: ServiceDep, campaign: CampaignDep, asked: Annotated[RunQuery, Query()]) -> RunListing:
    """Runs a page at a time; `next` of a page is `after` of the one that follows."""
    return run_page(service.store, campaign, asked)


@router.get("/{run}", response_model_by_alias=True)
def read_run(service: ServiceDep, campaign: CampaignDep, run: RunId) -> StoredRun:
    """Read a run with its specification and outcome."""
    stored = stored_run(service.store, campaign, run)
    if stored is None:
        message = f"{campaign.label} has no run {run}"
        raise NotFoundError(message)
    return stored


@router.get("/{run}/outcome", response_model_by_alias=True)
def read_outcome(service: ServiceDep, campaign: CampaignDep, run: RunId) -> Outcome:
    """What became of a run's mission."""
    outcome = read_run(service, campaign, run).outcome
    if outcome is None:
        message = f"run {run} of {campaign.label} is not flown"
        raise NotFoundError(message)
    return outcome


@router.get("/{run}/injection", response_model_by_alias=True)
def read_injection(service: ServiceDep, campaign: CampaignDep, run: RunId) -> InjectionRecord:
    """The injection of a run, in full."""
    record = read_outcome(service, campaign, run).injection
    if record is None:
        message = f"no fault was injected in run {run} of {campaign.label}"
        raise NotFoundError(message)
    return record


def repeatable(service: Service, campaign: CampaignEntry, run: int) -> Outcome:
    """The outcome of a run that can be flown again to the same bytes.

    :raises BadSpecError: if it cannot.
    """
    outcome = read_outcome(service, campaign, run)
    if outcome.spec.clock == "realtime":
        message = f"run {run} of {campaign.label} was flown in real time: it does not repeat"
        raise BadSpecError(message)
    return outcome


@router.post("/{run}/replay", responses=documented(409))
def replay_run(service: ServiceDep, campaign: CampaignDep, run: RunId) -> Replay:
    """Fly an injected run again and compare; answers when it is flown."""
    found = Replay.model_validate_json(rerun(read_outcome(service, campaign, run), "replay"))
    service.store.note_replay(run, found.answer)
    return found


@router.post("/{run}/series", status_code=201, responses=documented(409))
def record_series(service: ServiceDep, campaign: CampaignDep, run: RunId) -> FlightSeries:
    """Fly a run again and keep quality of flight and pose of every tick; answers when it is flown."""
    told = rerun(repeatable(service, campaign, run), "series")
    path = _series_file(service, campaign, run)
    draft = path.with_suffix(".part")
    draft.write_text(told)
    draft.replace(path)
    return FlightSeries.model_validate_json(told)


@router.get("/{run}/series")
def read_series(service: ServiceDep, campaign: CampaignDep, run: RunId) -> FlightSeries:
    """Quality of flight and pose of every tick, if they were recorded."""
    read_outcome(service, campaign, run)
    path = _series_file(service, campaign, run)
    if not path.is_file():
        message = f"run {run} of {campaign.label}: no series is recorded yet; POST here records one"
        raise NotFoundError(message)
    return FlightSeries.model_validate_json(path.read_text())


def _series_file(service: Service, campaign: CampaignEntry, run: int) -> FilePath:
    return service.store.artefacts(campaign) / f"run-{run}.series.json"
