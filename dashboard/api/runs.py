"""The runs of a campaign."""

from __future__ import annotations

from pathlib import Path as FilePath
from typing import Annotated

from fastapi import APIRouter, Path, Query

from dashboard.api.again import Series, again
from dashboard.api.problems import NotFoundError, documented
from dashboard.api.service import Found, Here, Service
from dashboard.campaigns.listing import LARGEST_ID, RunPage, RunQuery, StoredRun, run_page, stored_run
from dashboard.campaigns.store import Campaign
from deploy.check import BadSpecError
from deploy.replay import Replay
from services.bus.outcome import InjectionRecord, Outcome

router = APIRouter(prefix="/campaigns/{label}/runs", tags=["runs"], responses=documented(404, 422))

RunId = Annotated[int, Path(ge=0, le=LARGEST_ID)]


@router.get("")
def list_runs(here: Here, found: Found, asked: Annotated[RunQuery, Query()]) -> RunPage:
    """Runs a page at a time; `next` of a page is `after` of the one that follows."""
    return run_page(here.store, found, asked)


@router.get("/{run}", response_model_by_alias=True)
def read_run(here: Here, found: Found, run: RunId) -> StoredRun:
    """One run in full."""
    stored = stored_run(here.store, found, run)
    if stored is None:
        message = f"{found.label} has no run {run}"
        raise NotFoundError(message)
    return stored


@router.get("/{run}/outcome", response_model_by_alias=True)
def read_outcome(here: Here, found: Found, run: RunId) -> Outcome:
    """What became of a run's mission."""
    outcome = read_run(here, found, run).outcome
    if outcome is None:
        message = f"run {run} of {found.label} is not flown"
        raise NotFoundError(message)
    return outcome


@router.get("/{run}/injection", response_model_by_alias=True)
def read_injection(here: Here, found: Found, run: RunId) -> InjectionRecord:
    """The injection of a run, in full."""
    record = read_outcome(here, found, run).injection
    if record is None:
        message = f"no fault was injected in run {run} of {found.label}"
        raise NotFoundError(message)
    return record


def repeatable(here: Service, found: Campaign, run: int) -> Outcome:
    """The outcome of a run that can be flown again to the same bytes.

    :raises BadSpecError: if it cannot.
    """
    outcome = read_outcome(here, found, run)
    if outcome.spec.clock == "realtime":
        message = f"run {run} of {found.label} was flown in real time: it does not repeat"
        raise BadSpecError(message)
    return outcome


@router.post("/{run}/replay", responses=documented(409))
def replay_run(here: Here, found: Found, run: RunId) -> Replay:
    """Fly an injected run again and compare; answers when it is flown."""
    return Replay.model_validate_json(again(read_outcome(here, found, run), "replay"))


@router.post("/{run}/series", status_code=201, responses=documented(409))
def record_series(here: Here, found: Found, run: RunId) -> Series:
    """Fly a run again and keep quality of flight and pose of every tick; answers when it is flown."""
    told = again(repeatable(here, found, run), "series")
    path = _series_file(here, found, run)
    draft = path.with_suffix(".part")
    draft.write_text(told)
    draft.replace(path)
    return Series.model_validate_json(told)


@router.get("/{run}/series")
def read_series(here: Here, found: Found, run: RunId) -> Series:
    """Quality of flight and pose of every tick, if they were recorded."""
    read_outcome(here, found, run)
    path = _series_file(here, found, run)
    if not path.is_file():
        message = f"run {run} of {found.label}: no series is recorded yet; POST here records one"
        raise NotFoundError(message)
    return Series.model_validate_json(path.read_text())


def _series_file(here: Service, found: Campaign, run: int) -> FilePath:
    return here.store.artefacts(found) / f"run-{run}.series.json"
