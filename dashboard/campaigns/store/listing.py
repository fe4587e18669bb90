"""Campaigns and runs a page at a time, in an order that does not change between two pages."""

from __future__ import annotations

import base64
import binascii
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Literal

import sqlalchemy as sa
from pydantic import Field

from dashboard.campaigns.flight_record import Result
from dashboard.campaigns.state_machine import CampaignPhase, RunPhase
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.schema import OutcomeRow, ResultRow, RunRow
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError
from services.models.base import Strict
from services.models.mission import MissionSpec
from services.models.outcome import MissionResult, Outcome

MOST = 1000
"""Longest page."""

LARGEST_ID = 2**63 - 1

Phase = CampaignPhase | Literal["interrupted"]
Order = Literal["id", "seed", "flight_time_s", "distance_m", "energy_kj", "replans", "min_clearance_m"]

_RESULT = [column.name for column in fields(Result)]
_RUN = ("id", "arm", "world", "fault", "number", "seed", "phase", "attempts", "error")


class CampaignLine(Strict):
    """The phase and the progress of a campaign.

    ``interrupted``: its scheduler is gone, it can be resumed. ``queued``: also one that waits for its turn to
    be flown again.
    """

    campaign: str
    phase: Phase
    reason: str
    runs: int
    done: int
    failed: int
    created: str


class ArmLine(Strict):
    """How often an arm's missions succeeded, of those that were flown."""

    arm: str
    flown: int
    successes: int


class Files(Strict):
    """How many runs have files, and their size."""

    runs: int
    bytes: int


class RunLine(Strict):
    """A run and its result, if it has one."""

    id: int
    arm: str
    world: str
    fault: str
    number: int
    seed: int
    phase: RunPhase
    attempts: int
    error: str
    result: Result | None


class StoredRun(RunLine):
    """A run with its specification and outcome."""

    spec: MissionSpec
    outcome: Outcome | None


class RunQuery(Strict):
    """Which runs, in which order; ``after`` is what the page before said."""

    phase: RunPhase | None = None
    arm: str | None = None
    world: str | None = None
    fault: str | None = None
    result: MissionResult | None = None
    node_result: str | None = Field(default=None, description="of the node aimed at")
    sort: Order = "id"
    descending: bool = False
    limit: int = Field(default=100, ge=1, le=MOST)
    after: str | None = Field(default=None, max_length=200, description="`next` of the page before")


class RunListing(Strict):
    """Some runs; ``next`` asks for those that follow, None after the last."""

    runs: list[RunLine]
    next: str | None


class CampaignListing(Strict):
    """Some campaigns, the newest first; ``next`` asks for those that follow."""

    campaigns: list[CampaignLine]
    next: int | None


def line(store: Store, one: CampaignEntry) -> CampaignLine:
    """The phase and the progress of a campaign."""
    return _line(store, one, store.progress(one))


def _line(store: Store, one: CampaignEntry, counts: Counter[str]) -> CampaignLine:
    phase: Phase = one.phase
    if phase == "running" and not store.is_flying(one):
        phase = "interrupted"
    if phase in ("paused", "failed") and one.desired_state == "fly":
        phase = "queued"
    return CampaignLine(
        campaign=one.label,
        phase=phase,
        reason="" if phase == "queued" else one.reason,
        runs=sum(counts.values()),
        done=counts["done"],
        failed=counts["failed"],
        created=one.created,
    )


def files(store: Store, one: CampaignEntry) -> dict[str, Files]:
    """What became of the files of runs: kept, dropped, over quota."""
    return {fate: Files(runs=runs, bytes=size) for fate, (runs, size) in store.file_counts(one).items()}


def campaign_page(store: Store, limit: int, before: int | None) -> CampaignListing:
    """Campaigns with numbers below ``before``, the newest first."""
    found = store.newest(limit + 1, before)
    query = sa.select(RunRow.campaign_id, RunRow.phase, sa.func.count())
    query = query.where(RunRow.campaign_id.in_([one.id for one in found]))
    counts: dict[int, Counter[str]] = {}
    with store.reading() as connection:
        for number, phase, count in connection.execute(query.group_by(RunRow.campaign_id, RunRow.phase)):
            counts.setdefault(number, Counter())[phase] = count
    lines = [_line(store, one, counts.get(one.id, Counter())) for one in found[:limit]]
    return CampaignListing(campaigns=lines, next=found[limit - 1].id if len(found) > limit else None)


def arm_lines(store: Store, campaigns: Sequence[CampaignEntry]) -> dict[str, list[ArmLine]]:
    """The success of every arm that has flown, by the campaign's label, in the order of the specification."""
    query = (
        sa.select(
            RunRow.campaign_id,
            RunRow.arm,
            sa.func.count(),
            sa.func.sum(sa.cast(ResultRow.success, sa.Integer)),
        )
        .join(ResultRow, ResultRow.run_id == RunRow.id)
        .where(RunRow.campaign_id.in_([one.id for one in campaigns]))
        .group_by(RunRow.campaign_id, RunRow.arm)
    )
    with store.reading() as connection:
        found = {(row[0], row[1]): row for row in connection.execute(query)}
    return {
        one.label: [
            ArmLine(arm=arm.name, flown=row[2], successes=int(row[3]))
            for arm in one.spec.arms
            if (row := found.get((one.id, arm.name))) is not None
        ]
        for one in campaigns
    }


def run_page(store: Store, campaign: CampaignEntry, asked: RunQuery) -> RunListing:
    """Some of a campaign's runs; those without a result come last where a result's column orders them.

    :raises BadSpecError: if ``asked.after`` is not what a page has said.
    """
    column: Any = getattr(RunRow if asked.sort in _RUN else ResultRow, asked.sort)
    query = (
        sa.select(*(getattr(RunRow, name) for name in _RUN), *(getattr(ResultRow, name) for name in _RESULT))
        .join(ResultRow, ResultRow.run_id == RunRow.id, isouter=True)
        .where(RunRow.campaign_id == campaign.id, *_filters(asked))
        .order_by(*_order(asked, column))
        .limit(asked.limit + 1)
    )
    if asked.after is not None:
        query = query.where(_beyond(asked, column))
    with store.reading() as connection:
        rows = connection.execute(query).all()
    last = rows[asked.limit - 1] if len(rows) > asked.limit else None
    return RunListing(
        runs=[RunLine(**_fields(row)) for row in rows[: asked.limit]],
        next=_cursor(getattr(last, asked.sort), last.id) if last is not None else None,
    )


def stored_run(store: Store, campaign: CampaignEntry, number: int) -> StoredRun | None:
    """The run of that id, if it is one of the campaign's."""
    query = (
        sa.select(RunRow.__table__, *(getattr(ResultRow, name) for name in _RESULT), OutcomeRow.outcome)
        .join(ResultRow, ResultRow.run_id == RunRow.id, isouter=True)
        .join(OutcomeRow, OutcomeRow.run_id == RunRow.id, isouter=True)
        .where(RunRow.campaign_id == campaign.id, RunRow.id == number)
    )
    with store.reading() as connection:
        row = connection.execute(query).first()
    if row is None:
        return None
    return StoredRun(
        **_fields(row),
        spec=MissionSpec.model_validate_json(row.spec),
        outcome=Outcome.model_validate_json(row.outcome) if row.outcome is not None else None,
    )


def _fields(row: Any) -> dict[str, Any]:
    result = Result(**{name: getattr(row, name) for name in _RESULT}) if row.result is not None else None
    return {**{name: getattr(row, name) for name in _RUN}, "result": result}


def _filters(asked: RunQuery) -> list[sa.ColumnElement[bool]]:
    wanted = {
        RunRow.phase: asked.phase,
        RunRow.arm: asked.arm,
        RunRow.world: asked.world,
        RunRow.fault: asked.fault,
        ResultRow.result: asked.result,
        ResultRow.node_result: asked.node_result,
    }
    return [column == value for column, value in wanted.items() if value is not None]


def _order(asked: RunQuery, column: Any) -> Sequence[Any]:
    if asked.sort == "id":
        return (RunRow.id.desc() if asked.descending else RunRow.id.asc(),)
    return (column.is_(None), column.desc() if asked.descending else column.asc(), RunRow.id)


def _beyond(asked: RunQuery, column: Any) -> sa.ColumnElement[bool]:
    value, last = _read_cursor(asked.after or "")
    if asked.sort == "id":
        return RunRow.id < last if asked.descending else RunRow.id > last
    later = RunRow.id > last
    if value is None:
        return sa.and_(column.is_(None), later)
    further = column < value if asked.descending else column > value
    return sa.or_(further, sa.and_(column == value, later), column.is_(None))


def _cursor(value: float | None, last: int) -> str:
    return base64.urlsafe_b64encode(json.dumps([value, last]).encode()).decode()


def _read_cursor(text: str) -> tuple[float | None, int]:
    try:
        value, last = json.loads(base64.urlsafe_b64decode(text))
    except (binascii.Error, ValueError, TypeError):
        value, last = "", 0
    if not (value is None or type(value) in (int, float)) or type(last) is not int or abs(last) > LARGEST_ID:
        message = "after: not the `next` of a page"
        raise BadSpecError(message)
    return value, last
