"""REST resources ``/programs`` and ``/program-studies``: faults in runs of programs that the owner allows."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Query, Response
from fastapi.responses import FileResponse
from pydantic import Field

from dashboard.analysis.kernel_study import OutcomeShare, StudySummary
from dashboard.api.problems import NotFoundError, documented
from dashboard.api.processes.program_studies import StudyEntry, StudyPhase
from dashboard.api.processes.study_reader import StudyReader
from dashboard.api.programs import ForbiddenError
from dashboard.api.routes.campaigns import RequestKey
from dashboard.api.service import Service, ServiceDep
from dashboard.campaigns.commands import ConflictError
from dashboard.campaigns.store.listing import LARGEST_ID
from deploy.errors import BadSpecError
from deploy.kernel_study.program_study import ProgramStudySpec, changed_study
from injector.kernel_study.results import StudyResult, StudyRun
from services.models.base import Strict
from services.models.faults.specification import FaultSpec

MOST_RUNS = 100_000
"""Of a study that is asked for over HTTP: as many as of a campaign."""

Way = Literal["class", "register", "role", "bit", "module", "symbol", "line"]
"""By what the outcomes can be divided."""

router = APIRouter(tags=["programs"], responses=documented(404, 422))


class StruckProgram(Strict):
    """A program with what is struck of it; its environment is not told."""

    program: str = Field(description="the name of the owner's file")
    command: tuple[str, ...]
    module: str
    symbol: str
    address: int | None
    line: str
    fault: FaultSpec
    seed: int


class ProgramLine(StruckProgram):
    """A program that may be struck, with what holds where a request says nothing."""

    runs: int
    slots: int = Field(description="the most that a study may have at a time")


class NewProgramStudy(Strict):
    """Which of the allowed programs is to be struck; what is left out is as the owner's file says."""

    model_config = {"json_schema_extra": {"examples": [{"program": "gzip", "runs": 500, "seed": 1}]}}

    program: str = Field(max_length=60, description="one of `GET programs`")
    runs: int | None = Field(default=None, ge=1, le=MOST_RUNS)
    seed: int | None = Field(default=None, ge=0, lt=2**32)
    fault: dict[str, Any] | None = Field(default=None, description="fields of a fault: `bits`, `field` ...")
    slots: int | None = Field(default=None, ge=1, le=256, description="runs at a time, at most the service's")


class ProgramStudyLine(Strict):
    """Where a study of a program stands. ``queued``: also one that waits for its turn to go on."""

    study: str
    program: str
    phase: StudyPhase
    reason: str
    runs: int
    done: int
    created: str


class ProgramStudyListing(Strict):
    """Some studies, the newest first; ``next`` asks for those that follow."""

    studies: list[ProgramStudyLine]
    next: int | None


class ProgramStudyDetail(ProgramStudyLine):
    """Where a study stands, what was asked and what it has found so far."""

    struck: StruckProgram
    slots: int
    summary: StudySummary | None = Field(description="null before the program's instructions are counted")
    causes: dict[str, int] = Field(description="runs by outcome and what differed, the most frequent first")


class StudyGroup(Strict):
    """The injected runs that have something in common, with 95 % Wilson intervals."""

    name: str
    injected: int
    shares: dict[str, OutcomeShare]


class StudyBreakdown(Strict):
    """The outcomes divided by what was struck, the largest group first."""

    study: str
    by: Way
    groups: list[StudyGroup]


class StudyRunListing(Strict):
    """Some runs in the order of their numbers; ``next`` is ``after`` of the page that follows."""

    runs: list[StudyRun]
    next: int | None


def _study(label: str, service: ServiceDep) -> StudyEntry:
    entry = service.program_studies.studies.find(label)
    if entry is None:
        message = f"there is no study {label!r}"
        raise NotFoundError(message)
    return entry


StudyDep = Annotated[StudyEntry, Depends(_study)]
"""The study that the path names by its label."""


def program_lines(service: Service) -> list[ProgramLine]:
    """The programs that may be struck."""
    runner = service.program_studies
    return [
        ProgramLine(**dict(_struck(name, spec)), runs=min(spec.runs, MOST_RUNS), slots=runner.slots)
        for name, spec in runner.studies.allowed.items()
    ]


def _struck(program: str, spec: ProgramStudySpec) -> StruckProgram:
    found = spec.program
    return StruckProgram(
        program=program,
        command=found.command,
        module=found.module,
        symbol=found.symbol,
        address=found.address,
        line=found.line,
        fault=spec.fault,
        seed=spec.seed,
    )


def study_line(service: Service, entry: StudyEntry) -> ProgramStudyLine:
    """The phase and the progress of a study."""
    studies = service.program_studies.studies
    return ProgramStudyLine(
        study=entry.label,
        program=entry.program,
        phase=studies.phase(entry),
        reason=entry.reason,
        runs=entry.spec.runs,
        done=studies.count(entry.label),
        created=entry.created,
    )


def study_page(service: Service, limit: int, before: int | None) -> ProgramStudyListing:
    """So many studies, the newest first, from the one before that number on."""
    found = [
        one for one in service.program_studies.studies.entries() if before is None or one.number < before
    ]
    following = found[limit - 1].number if len(found) > limit else None
    return ProgramStudyListing(
        studies=[study_line(service, entry) for entry in found[:limit]], next=following
    )


def reader(service: Service, entry: StudyEntry) -> StudyReader:
    """What reads the runs of a study."""
    return service.study_readers.of(service.program_studies.studies.runs(entry.label))


def study_detail(service: Service, entry: StudyEntry) -> ProgramStudyDetail:
    """Where a study stands, and what it has found so far."""
    found = reader(service, entry)
    return ProgramStudyDetail(
        **dict(study_line(service, entry)),
        struck=_struck(entry.program, entry.spec),
        slots=min(entry.slots or service.program_studies.slots, service.program_studies.slots),
        summary=found.summary(),
        causes=found.causes(),
    )


def create_study(service: Service, new: NewProgramStudy, request: str | None = None) -> StudyEntry:
    """Keep a study of an allowed program, to be made in its turn.

    :raises ForbiddenError: if the owner has not allowed the program.
    :raises BadSpecError: if it cannot be made so.
    """
    runner = service.program_studies
    allowed = runner.studies.allowed.get(new.program)
    if allowed is None:
        message = (
            f"program: {new.program!r} is no program that the service was started with: "
            "zenfi serve --programs FOLDER"
        )
        raise ForbiddenError(message)
    if new.slots is not None and new.slots > runner.slots:
        message = f"slots: the service has {runner.slots}, got {new.slots}"
        raise BadSpecError(message)
    runs = new.runs if new.runs is not None else min(allowed.runs, MOST_RUNS)
    seed = new.seed if new.seed is not None else allowed.seed
    spec = changed_study(allowed, new.fault, runs=runs, seed=seed)
    entry = runner.studies.create(new.program, spec, new.slots, request or "")
    runner.notify()
    return entry


@router.get("/programs")
def list_programs(service: ServiceDep) -> list[ProgramLine]:
    """The programs whose runs may be struck: those in the folder that the owner named at the start."""
    return program_lines(service)


@router.post(
    "/program-studies",
    status_code=201,
    responses={200: {"model": ProgramStudyDetail}, **documented(403, 413)},
)
def create_program_study(
    service: ServiceDep, new: NewProgramStudy, response: Response, idempotency_key: RequestKey = None
) -> ProgramStudyDetail:
    """Strike runs of an allowed program, after the studies that were asked for before."""
    known = {one.label for one in service.program_studies.studies.entries()} if idempotency_key else set()
    entry = create_study(service, new, idempotency_key)
    if entry.label in known:
        response.status_code = 200
    response.headers["Location"] = f"/api/v1/program-studies/{entry.label}"
    return study_detail(service, entry)


@router.get("/program-studies")
def list_program_studies(
    service: ServiceDep,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    before: Annotated[int | None, Query(ge=0, le=LARGEST_ID, description="`next` of the page before")] = None,
) -> ProgramStudyListing:
    """Every study of a program, the newest first."""
    return study_page(service, limit, before)


@router.get("/program-studies/{label}")
def read_program_study(service: ServiceDep, entry: StudyDep) -> ProgramStudyDetail:
    """Where a study stands, and its outcomes so far, with 95 % Wilson intervals."""
    return study_detail(service, entry)


@router.get("/program-studies/{label}/breakdown")
def read_breakdown(
    service: ServiceDep, entry: StudyDep, by: Annotated[Way, Query()] = "register"
) -> StudyBreakdown:
    """The outcomes divided by what was struck."""
    groups = [
        StudyGroup(name=name, injected=count, shares=shares)
        for name, count, shares in reader(service, entry).divided(by)
    ]
    return StudyBreakdown(study=entry.label, by=by, groups=groups)


@router.get("/program-studies/{label}/runs")
def list_study_runs(
    service: ServiceDep,
    entry: StudyDep,
    limit: Annotated[int, Query(ge=1, le=500)] = 100,
    after: Annotated[int, Query(ge=-1, le=LARGEST_ID, description="`next` of the page before")] = -1,
    result: StudyResult | None = None,
) -> StudyRunListing:
    """The runs that are made, in the order of their numbers, with what was corrupted in each."""
    runs, following = reader(service, entry).page(after, limit, result)
    return StudyRunListing(runs=runs, next=following)


@router.get("/program-studies/{label}/runs/{run}")
def read_study_run(
    service: ServiceDep, entry: StudyDep, run: Annotated[int, Path(ge=0, le=LARGEST_ID)]
) -> StudyRun:
    """A run with what was corrupted, and what came of it."""
    found = reader(service, entry).run(run)
    if found is None:
        message = f"run {run} of {entry.label} is not made"
        raise NotFoundError(message)
    return found


@router.get(
    "/program-studies/{label}/file",
    response_class=FileResponse,
    responses={200: {"content": {"application/jsonl": {"schema": {"type": "string", "format": "binary"}}}}},
)
def read_study_file(service: ServiceDep, entry: StudyDep) -> Response:
    """The file of the runs, as `zenfi program run --output` writes it and `zenfi program replay` reads it."""
    path = service.program_studies.studies.runs(entry.label)
    if not path.is_file():
        message = f"{entry.label} has no run yet"
        raise NotFoundError(message)
    return Response(path.read_bytes(), media_type="application/jsonl")


@router.post("/program-studies/{label}/pause", status_code=202, responses=documented(409))
def pause_program_study(service: ServiceDep, entry: StudyDep) -> ProgramStudyDetail:
    """Have a study left in a moment; what is made stays."""
    if not service.program_studies.studies.move(entry.label, "paused", of=("queued",), reason="paused"):
        _refuse(entry, "paused")
    return _changed(service, entry)


@router.post("/program-studies/{label}/resume", status_code=202, responses=documented(403, 409))
def resume_program_study(service: ServiceDep, entry: StudyDep) -> ProgramStudyDetail:
    """Make what is left of a study, in its turn; refused if its program is no longer allowed."""
    studies = service.program_studies.studies
    if not studies.is_allowed(entry):
        message = (
            f"{entry.program} is no longer a program that may be struck, or another one: "
            "zenfi serve --programs FOLDER"
        )
        raise ForbiddenError(message)
    if not studies.move(entry.label, "queued", of=("paused", "failed", "queued")):
        _refuse(entry, "resumed")
    return _changed(service, entry)


@router.post("/program-studies/{label}/cancel", status_code=202, responses=documented(409))
def cancel_program_study(service: ServiceDep, entry: StudyDep) -> ProgramStudyDetail:
    """Give a study up; what is made stays."""
    if not service.program_studies.studies.move(
        entry.label, "cancelled", of=("queued", "paused", "failed"), reason="cancelled"
    ):
        _refuse(entry, "cancelled")
    return _changed(service, entry)


@router.delete("/program-studies/{label}", status_code=204, responses=documented(409))
def delete_program_study(service: ServiceDep, entry: StudyDep) -> None:
    """Remove a study with all its runs; refused while it is made or waits to be."""
    studies = service.program_studies.studies
    if not studies.delete(entry.label):
        message = f"{entry.label} is {studies.phase(entry)}: cancel or pause it first, and wait a moment"
        raise ConflictError(message)


def _refuse(entry: StudyEntry, what: str) -> None:
    message = f"{entry.label} is {entry.phase}: it cannot be {what}"
    raise ConflictError(message)


def _changed(service: Service, entry: StudyEntry) -> ProgramStudyDetail:
    service.program_studies.notify()
    return study_detail(service, _study(entry.label, service))
