"""Opens a store and reads from it: campaigns, their runs and their results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from pydantic import ValidationError

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.spec import CampaignSpec, Cell, Run, cells
from dashboard.campaigns.state_machine import CampaignPhase, CampaignStates, RunState
from dashboard.campaigns.store import postgresql
from dashboard.campaigns.store.columns import Rows, RunColumns
from dashboard.campaigns.store.database import Database
from dashboard.campaigns.store.folder import default_folder
from dashboard.campaigns.store.schema import CampaignRow, OutcomeRow, ResultRow, RunRow
from dashboard.campaigns.store.sqlite import SqliteDatabase
from deploy.errors import BadSpecError, one_line
from services.models.mission import MissionSpec

DATABASE_FILE = "zenfi.sqlite"
"""The database of a store in a folder."""

LONGEST_NUMBER = 18
"""Digits of a campaign's number; the database's integers have 64 bits."""

ROWS_AT_ONCE = 1000
"""Of a long table, so many rows are in memory; PostgreSQL's driver would fetch them all."""

NOTHING: sa.ColumnElement[str] = sa.literal_column("''")
"""Empty text, written out: an index of what is not empty is found only by its own words."""

_RUN_COLUMNS = ("id", "arm", "world", "fault", "number", "seed", "phase", "attempts", "error")
_RESULT_COLUMNS = [column.name for column in fields(Result)]


class UnknownCampaignError(BadSpecError):
    """There is no campaign of that label in a store."""

    def __init__(self, label: str, place: str) -> None:
        super().__init__(f"no campaign {label!r} in {place}: see zenfi campaign list")
        self.label = label


@dataclass(frozen=True, slots=True)
class CampaignEntry:
    """A campaign as stored; ``label`` is what people call it.

    ``desired_state`` is the last command that its process has not carried out yet.
    """

    id: int
    spec: CampaignSpec
    phase: CampaignPhase
    reason: str
    created: str
    desired_state: str = ""

    @property
    def label(self) -> str:
        """The name and the number of the campaign."""
        return f"{self.spec.name}-{self.id}"


class StoreQueries:
    """Opens the store in a folder or at a PostgreSQL URL and answers questions about what it holds.

    The database is made, or brought up to date, if need be. ``folder`` has the artefacts; those of a store
    at a URL lie in the user's folder for data. ``where`` may hold a password: show people :attr:`place`.

    :raises BadSpecError: if the folder or the database cannot be opened.
    """

    def __init__(self, where: Path | str) -> None:
        self.where = str(where)
        self.database: Database
        if "://" in str(where):
            server = postgresql.PostgresqlDatabase(postgresql.parse(str(where)))
            self.database, self.folder = server, default_folder() / "postgresql" / server.identity
            _make_folder(self.folder)
        else:
            self.folder = Path(where)
            _make_folder(self.folder)
            self.database = SqliteDatabase(self.folder / DATABASE_FILE)
        self._columns = RunColumns(self.database)

    @property
    def place(self) -> str:
        """What people call it: its file, or its URL without the password."""
        return self.database.place

    def close(self) -> None:
        """Close every connection to the database."""
        self.database.close()

    def reading(self) -> AbstractContextManager[sa.Connection]:
        """A database connection for queries."""
        return self.database.reading()

    # -- campaigns ---------------------------------------------------------------------------------

    def campaigns(self) -> list[CampaignEntry]:
        """All campaigns, the oldest first."""
        with self.database.reading() as connection:
            query = sa.select(CampaignRow.__table__).where(CampaignRow.deleted == "")
            return [_campaign(row) for row in connection.execute(query.order_by(CampaignRow.id))]

    def newest(self, limit: int, before: int | None = None) -> list[CampaignEntry]:
        """So many campaigns with numbers below ``before``, the newest first."""
        query = sa.select(CampaignRow.__table__).where(CampaignRow.deleted == "")
        query = query.order_by(CampaignRow.id.desc()).limit(limit)
        if before is not None:
            query = query.where(CampaignRow.id < before)
        with self.database.reading() as connection:
            return [_campaign(row) for row in connection.execute(query)]

    def requested(self, request: str) -> CampaignEntry | None:
        """The campaign that a request created."""
        query = sa.select(CampaignRow.__table__).where(CampaignRow.request == request)
        with self.database.reading() as connection:
            row = connection.execute(query.where(CampaignRow.deleted == "")).first()
        return _campaign(row) if row is not None else None

    def to_be_flown(self) -> list[CampaignEntry]:
        """The campaigns that a service is to fly, the oldest first."""
        query = sa.select(CampaignRow.__table__).where(CampaignRow.wish == "fly", CampaignRow.deleted == "")
        with self.database.reading() as connection:
            return [_campaign(row) for row in connection.execute(query.order_by(CampaignRow.id))]

    def find(self, label: str) -> CampaignEntry:
        """The campaign of that label or number.

        :raises UnknownCampaignError: if there is none.
        """
        name, _, number = label.rpartition("-")
        if number.isdecimal() and len(number) <= LONGEST_NUMBER:
            with self.database.reading() as connection:
                query = sa.select(CampaignRow.__table__).where(CampaignRow.id == int(number))
                row = connection.execute(query.where(CampaignRow.deleted == "")).first()
            if row is not None and name in ("", row.name):
                return _campaign(row)
        raise UnknownCampaignError(label, self.place)

    def desired_state(self, campaign: CampaignEntry) -> str:
        """The state that was asked for last; empty if nothing is asked for."""
        with self.database.reading() as connection:
            query = sa.select(CampaignRow.wish).where(CampaignRow.id == campaign.id)
            return str(connection.execute(query).scalar_one())

    # -- runs and results --------------------------------------------------------------------------

    def states(self, campaign: CampaignEntry) -> CampaignStates:
        """Where a campaign and its runs stand."""
        query = sa.select(RunRow.id, RunRow.phase, RunRow.attempts, RunRow.lease, RunRow.error)
        with self.database.reading() as connection:
            rows = connection.execute(query.where(RunRow.campaign_id == campaign.id).order_by(RunRow.id))
            found = {row.id: RunState(row.phase, row.attempts, row.lease, row.error) for row in rows}
        return CampaignStates(found, campaign.spec.limits.attempts, campaign.phase, campaign.reason)

    def planned(self, campaign: CampaignEntry) -> dict[int, Run]:
        """Every run by its id, in the order of planning."""
        query = sa.select(RunRow.id, RunRow.arm, RunRow.number, RunRow.spec, RunRow.fault)
        with self.database.reading() as connection:
            rows = connection.execute(query.where(RunRow.campaign_id == campaign.id).order_by(RunRow.id))
            return {
                row.id: Run(row.arm, row.number, MissionSpec.model_validate_json(row.spec), row.fault)
                for row in rows
            }

    def progress(self, campaign: CampaignEntry) -> Counter[str]:
        """How many runs are in each phase."""
        query = sa.select(RunRow.phase, sa.func.count()).group_by(RunRow.phase)
        with self.database.reading() as connection:
            rows = connection.execute(query.where(RunRow.campaign_id == campaign.id))
            return Counter({row[0]: row[1] for row in rows})

    def file_counts(self, campaign: CampaignEntry) -> dict[str, tuple[int, int]]:
        """What became of the files of runs: how many runs, and their bytes."""
        query = (
            sa.select(ResultRow.artefact, sa.func.count(), sa.func.sum(ResultRow.artefact_bytes))
            .join(RunRow, RunRow.id == ResultRow.run_id)
            .where(RunRow.campaign_id == campaign.id, ResultRow.artefact != NOTHING)
            .group_by(ResultRow.artefact)
        )
        with self.database.reading() as connection:
            return {row[0]: (row[1], int(row[2])) for row in connection.execute(query)}

    def replay_counts(self, campaign: CampaignEntry) -> dict[str, int]:
        """How many runs were flown again, by what came of it the last time."""
        query = (
            sa.select(ResultRow.replay, sa.func.count())
            .join(RunRow, RunRow.id == ResultRow.run_id)
            .where(RunRow.campaign_id == campaign.id, ResultRow.replay != NOTHING)
            .group_by(ResultRow.replay)
        )
        with self.database.reading() as connection:
            return {row[0]: row[1] for row in connection.execute(query)}

    def records(self, campaign: CampaignEntry) -> Iterator[FlightRecord]:
        """Every run with its result, in the order of planning."""
        query = (
            sa.select(
                *(getattr(RunRow, name) for name in _RUN_COLUMNS),
                *(getattr(ResultRow, n) for n in _RESULT_COLUMNS),
            )
            .join(ResultRow, ResultRow.run_id == RunRow.id, isouter=True)
            .where(RunRow.campaign_id == campaign.id)
            .order_by(RunRow.id)
            .execution_options(yield_per=ROWS_AT_ONCE)
        )
        with self.database.reading() as connection:
            for row in connection.execute(query):
                result = (
                    Result(**{name: getattr(row, name) for name in _RESULT_COLUMNS})
                    if row.result is not None
                    else None
                )
                cell = Cell(row.arm, row.world, row.fault)
                yield FlightRecord(
                    cell, row.number, row.seed, row.phase, row.attempts, row.error, result, row.id
                )

    def columns(self, campaign: CampaignEntry) -> Rows:
        """Every run with its result as an array of :data:`~dashboard.campaigns.store.columns.COLUMNS`.

        In the order of planning. What was read before is kept; only what has changed is read.
        """
        return self._columns.read(campaign.id, cells(campaign.spec))

    def outcome_size(self) -> float | None:
        """Mean bytes of the newest outcomes."""
        newest = sa.select(OutcomeRow.outcome).order_by(OutcomeRow.run_id.desc()).limit(ROWS_AT_ONCE)
        return self._mean(sa.func.length(newest.subquery().c.outcome))

    def wall_s(self, worlds: Sequence[str]) -> float | None:
        """Mean wall time of the newest flights that were flown in any of ``worlds``, of all campaigns."""
        newest = (
            sa.select(ResultRow.wall_s)
            .join(RunRow, RunRow.id == ResultRow.run_id)
            .where(RunRow.world.in_(worlds), ResultRow.proof == "")
            .order_by(ResultRow.run_id.desc())
            .limit(ROWS_AT_ONCE)
            .subquery()
        )
        return self._mean(newest.c.wall_s)

    def _mean(self, column: sa.ColumnElement[Any]) -> float | None:
        with self.database.reading() as connection:
            return connection.execute(sa.select(sa.func.avg(column))).scalar()


def _make_folder(root: Path) -> None:
    try:
        # What is in it is the user's alone.
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        (root / "artefacts").mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        message = f"store {root}: {error.strerror}; choose another with --store or ZENFI_HOME"
        raise BadSpecError(message) from error


def _campaign(row: Any) -> CampaignEntry:
    try:
        spec = CampaignSpec.model_validate_json(row.spec)
    except ValidationError as error:
        message = f"{row.name}-{row.id}: stored by another version of zenfi: {one_line(error)}"
        raise BadSpecError(message) from error
    return CampaignEntry(row.id, spec, row.phase, row.reason, row.created, row.wish)


def outcome_fields(database: Database) -> sa.ColumnElement[Any]:
    """The outcomes as JSON, of which a query can ask for fields: ``outcome_fields(...)["injection"]``."""
    # PostgreSQL has a type for JSON, SQLite has functions for its text.
    text = database.engine.dialect.name == "sqlite"
    return (sa.type_coerce if text else sa.cast)(OutcomeRow.outcome, sa.JSON)
