"""Where campaigns live: a database (a SQLite file, or PostgreSQL) and a folder of artefacts.

Many may read; a campaign is written by the one scheduler that holds its lock, which is freed when that
process ends, however it ends.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import sqlalchemy as sa
from pydantic import ValidationError

from dashboard.campaigns import postgresql, removal
from dashboard.campaigns.database import Database
from dashboard.campaigns.recording import Filed
from dashboard.campaigns.records import Record, Result
from dashboard.campaigns.schema import CampaignRow, ResultRow, RunRow
from dashboard.campaigns.spec import CampaignSpec, Cell, Run, runs
from dashboard.campaigns.sqlite import SqliteDatabase
from dashboard.campaigns.states import CampaignPhase, CampaignStates, RunState
from deploy.check import BadSpecError, one_line
from services.bus.mission import MissionSpec
from services.bus.outcome import Outcome

LONGEST_NUMBER = 18
"""Digits of a campaign's number; the database's integers have 64 bits."""

_COLUMNS = [column.name for column in fields(Result)]
_READ = ("id", "arm", "world", "fault", "number", "seed", "phase", "attempts", "error")
_RUNS = RunRow.metadata.tables[RunRow.__tablename__]
_MOVE_RUN = (
    sa.update(_RUNS)
    .where(_RUNS.c.id == sa.bindparam("run"))
    .values({column.name: sa.bindparam(f"new_{column.name}") for column in fields(RunState)})
)


Wish = Literal["", "fly", "pause", "cancel"]
"""What is asked of whoever flies a campaign; ``fly`` of the service, which goes on after a crash."""


class BusyError(BadSpecError):
    """Another process is flying this campaign."""


class UnknownCampaignError(BadSpecError):
    """There is no campaign of that label in a store."""

    def __init__(self, label: str, place: str) -> None:
        super().__init__(f"no campaign {label!r} in {place}: see zenfi campaign list")
        self.label = label


class RepeatedError(BadSpecError):
    """The request has created a campaign already."""

    def __init__(self, request: str | None) -> None:
        super().__init__(f"request {request!r} has created a campaign already")


@dataclass(frozen=True, slots=True)
class Campaign:
    """A campaign as stored; ``label`` is what people call it, ``wish`` what was asked last."""

    id: int
    spec: CampaignSpec
    phase: CampaignPhase
    reason: str
    created: str
    wish: str = ""

    @property
    def label(self) -> str:
        """Its name and number."""
        return f"{self.spec.name}-{self.id}"


def default_folder() -> Path:
    """``ZENFI_HOME``, or the user's folder for data."""
    home = os.environ.get("ZENFI_HOME")
    return Path(home) if home else Path.home() / ".local" / "share" / "zenfi"


class Store:
    """Opens the store in a folder or at a PostgreSQL URL, made or brought up to date if need be.

    ``folder`` has its artefacts; of a store at a URL, they lie in the user's folder for data. ``where`` may
    hold a password: it is not for people, see :attr:`place`.

    :raises BadSpecError: if that cannot be.
    """

    def __init__(self, where: Path | str) -> None:
        self.where = str(where)
        self.database: Database
        if "://" in str(where):
            server = postgresql.PostgresqlDatabase(postgresql.parse(str(where)))
            self.database, self.folder = server, default_folder() / "postgresql" / server.identity
            self._make_folder()
        else:
            self.folder = Path(where)
            self._make_folder()
            self.database = SqliteDatabase(self.folder / "zenfi.sqlite")

    def _make_folder(self) -> None:
        try:
            (self.folder / "artefacts").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            message = f"store {self.folder}: {error.strerror}; choose another with --store or ZENFI_HOME"
            raise BadSpecError(message) from error

    @property
    def place(self) -> str:
        """What people call it: its file, or its URL without the password."""
        return self.database.place

    def close(self) -> None:
        """Close every connection."""
        self.database.close()

    def reading(self) -> AbstractContextManager[sa.Connection]:
        """A connection for queries."""
        return self.database.reading()

    def limit(self, disk_mb: int) -> None:
        """Let the database grow to ``disk_mb`` and no further."""
        self.database.limit(disk_mb)

    # -- campaigns ---------------------------------------------------------------------------------

    def create(self, spec: CampaignSpec, wish: Wish = "", request: str | None = None) -> Campaign:
        """Store a campaign with all its runs, queued.

        :raises RepeatedError: if a campaign of that ``request`` is there already.
        """
        with self.database.writing() as connection:
            created = datetime.now(UTC).isoformat(timespec="seconds")
            row = {"name": spec.name, "spec": spec.model_dump_json(), "phase": "queued", "created": created}
            try:
                key = connection.execute(
                    sa.insert(CampaignRow).values(**row, reason="", wish=wish, request=request)
                ).inserted_primary_key
            except sa.exc.IntegrityError as error:
                raise RepeatedError(request) from error
            assert key is not None  # noqa: S101 - an insert has one
            connection.execute(sa.insert(RunRow), [_row(int(key[0]), run) for run in runs(spec)])
        return Campaign(int(key[0]), spec, "queued", "", created, wish)

    def campaigns(self) -> list[Campaign]:
        """All of them, the oldest first."""
        with self.database.reading() as connection:
            query = sa.select(CampaignRow.__table__).where(CampaignRow.deleted == "")
            return [_campaign(row) for row in connection.execute(query.order_by(CampaignRow.id))]

    def newest(self, limit: int, before: int | None = None) -> list[Campaign]:
        """So many campaigns with numbers below ``before``, the newest first."""
        query = sa.select(CampaignRow.__table__).where(CampaignRow.deleted == "")
        query = query.order_by(CampaignRow.id.desc()).limit(limit)
        if before is not None:
            query = query.where(CampaignRow.id < before)
        with self.database.reading() as connection:
            return [_campaign(row) for row in connection.execute(query)]

    def requested(self, request: str) -> Campaign | None:
        """The campaign that a request created."""
        query = sa.select(CampaignRow.__table__).where(CampaignRow.request == request)
        with self.database.reading() as connection:
            row = connection.execute(query.where(CampaignRow.deleted == "")).first()
        return _campaign(row) if row is not None else None

    def wanted(self) -> list[Campaign]:
        """The campaigns that a service is to fly, the oldest first."""
        query = sa.select(CampaignRow.__table__).where(CampaignRow.wish == "fly", CampaignRow.deleted == "")
        with self.database.reading() as connection:
            return [_campaign(row) for row in connection.execute(query.order_by(CampaignRow.id))]

    def find(self, label: str) -> Campaign:
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

    def artefacts(self, campaign: Campaign) -> Path:
        """The folder for a campaign's files, made if need be.

        :raises BadSpecError: if it cannot be made, or lies outside the folder of artefacts, by a link.
        """
        try:
            folder = self._folder(campaign.spec, campaign.label)
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            message = (
                f"artefacts: no folder for {campaign.label}: {error.strerror}: {str(error.filename)[:200]}"
            )
            raise BadSpecError(message) from error
        return folder

    def _folder(self, spec: CampaignSpec, label: str) -> Path:
        root = (self.folder / "artefacts").resolve()
        folder = (root / spec.artefacts / label).resolve()
        if not folder.is_relative_to(root):
            message = f"artefacts: {spec.artefacts!r} leads out of {root}"
            raise BadSpecError(message)
        return folder

    def delete(self, campaign: Campaign) -> None:
        """Remove a campaign with its runs, results and files; killed midway, nobody is shown what is left.

        :raises BusyError: if it is being flown.
        """
        with self.lock(campaign):
            removal.hide(self.database, campaign.id)
        self.sweep()

    def sweep(self) -> None:
        """Remove what is left of campaigns that were deleted."""
        for number, name, spec in removal.left_over(self.database):
            folder = self._folder(CampaignSpec.model_validate_json(spec), f"{name}-{number}")
            removal.remove(self.database, number, folder)

    @contextmanager
    def lock(self, campaign: Campaign) -> Iterator[None]:
        """Be the only one that writes to a campaign.

        :raises BusyError: if somebody else is.
        """
        with self.database.lock(campaign.id) as got:
            if not got:
                message = f"{campaign.label} is being flown by another process"
                raise BusyError(message)
            if removal.is_hidden(self.database, campaign.id):
                message = f"{campaign.label} was deleted"
                raise BadSpecError(message)
            yield

    def is_flying(self, campaign: Campaign) -> bool:
        """Whether some process is flying a campaign."""
        try:
            with self.lock(campaign):
                return False
        except BusyError:
            return True

    def wish(self, campaign: Campaign, what: Wish) -> None:
        """Ask the process that flies a campaign for something."""
        with self.database.writing() as connection:
            connection.execute(sa.update(CampaignRow).where(CampaignRow.id == campaign.id).values(wish=what))

    def wished(self, campaign: Campaign) -> str:
        """What was asked for."""
        with self.database.reading() as connection:
            query = sa.select(CampaignRow.wish).where(CampaignRow.id == campaign.id)
            return str(connection.execute(query).scalar_one())

    # -- runs --------------------------------------------------------------------------------------

    def states(self, campaign: Campaign) -> CampaignStates:
        """Where a campaign and its runs stand."""
        query = sa.select(RunRow.id, RunRow.phase, RunRow.attempts, RunRow.lease, RunRow.error)
        with self.database.reading() as connection:
            rows = connection.execute(query.where(RunRow.campaign_id == campaign.id).order_by(RunRow.id))
            found = {row.id: RunState(row.phase, row.attempts, row.lease, row.error) for row in rows}
        return CampaignStates(found, campaign.spec.limits.attempts, campaign.phase, campaign.reason)

    def planned(self, campaign: Campaign) -> dict[int, Run]:
        """Every run by its id, in the order of planning."""
        query = sa.select(RunRow.id, RunRow.arm, RunRow.number, RunRow.spec, RunRow.fault)
        with self.database.reading() as connection:
            rows = connection.execute(query.where(RunRow.campaign_id == campaign.id).order_by(RunRow.id))
            return {
                row.id: Run(row.arm, row.number, MissionSpec.model_validate_json(row.spec), row.fault)
                for row in rows
            }

    def write(
        self,
        campaign: Campaign,
        states: CampaignStates,
        changed: Sequence[int],
        flown: Mapping[int, Outcome],
        files: Mapping[int, Filed] = MappingProxyType({}),
    ) -> None:
        """Changed states and their results, with what became of their files, together or not at all.

        :raises StoreError: and nothing is written.
        """
        with self.database.writing(campaign.id) as connection:
            if flown:
                connection.execute(
                    sa.insert(ResultRow),
                    [
                        {
                            "run_id": run,
                            "outcome": outcome.model_dump_json(by_alias=True),
                            **asdict(Result.of(outcome)),
                            "artefact": files.get(run, Filed()).fate,
                            "artefact_bytes": files.get(run, Filed()).size,
                        }
                        for run, outcome in flown.items()
                    ],
                )
            if changed:
                rows = [{"run": run, **_renamed(states.runs[run])} for run in dict.fromkeys(changed)]
                connection.execute(_MOVE_RUN, rows)
            connection.execute(
                sa.update(CampaignRow)
                .where(CampaignRow.id == campaign.id)
                .values(phase=states.phase, reason=states.reason)
            )

    def progress(self, campaign: Campaign) -> Counter[str]:
        """How many runs are in each phase."""
        query = sa.select(RunRow.phase, sa.func.count()).group_by(RunRow.phase)
        with self.database.reading() as connection:
            rows = connection.execute(query.where(RunRow.campaign_id == campaign.id))
            return Counter({row[0]: row[1] for row in rows})

    def filed(self, campaign: Campaign) -> dict[str, tuple[int, int]]:
        """What became of the files of runs: how many runs, and their bytes."""
        query = (
            sa.select(ResultRow.artefact, sa.func.count(), sa.func.sum(ResultRow.artefact_bytes))
            .join(RunRow, RunRow.id == ResultRow.run_id)
            .where(RunRow.campaign_id == campaign.id, ResultRow.artefact != "")
            .group_by(ResultRow.artefact)
        )
        with self.database.reading() as connection:
            return {row[0]: (row[1], int(row[2])) for row in connection.execute(query)}

    # -- reading -----------------------------------------------------------------------------------

    def records(self, campaign: Campaign) -> Iterator[Record]:
        """Every run with its result, in the order of planning."""
        query = (
            sa.select(*(getattr(RunRow, name) for name in _READ), *(getattr(ResultRow, n) for n in _COLUMNS))
            .join(ResultRow, ResultRow.run_id == RunRow.id, isouter=True)
            .where(RunRow.campaign_id == campaign.id)
            .order_by(RunRow.id)
        )
        with self.database.reading() as connection:
            for row in connection.execute(query):
                result = (
                    Result(**{name: getattr(row, name) for name in _COLUMNS})
                    if row.result is not None
                    else None
                )
                cell = Cell(row.arm, row.world, row.fault)
                yield Record(cell, row.number, row.seed, row.phase, row.attempts, row.error, result, row.id)

    def outcome_size(self) -> float | None:
        """Mean bytes of a stored outcome."""
        return self._mean(sa.func.length(ResultRow.outcome))

    def wall_s(self, worlds: Sequence[str]) -> float | None:
        """Mean wall time of a flight in any of ``worlds``, of all campaigns."""
        return self._mean(ResultRow.wall_s, RunRow.world.in_(worlds))

    def _mean(self, column: Any, *where: Any) -> float | None:
        query = sa.select(sa.func.avg(column)).join(RunRow, RunRow.id == ResultRow.run_id).where(*where)
        with self.database.reading() as connection:
            return connection.execute(query).scalar()


def _renamed(state: RunState) -> dict[str, object]:
    # What a dying process wrote may hold a zero byte, which PostgreSQL's text does not.
    fields_ = {**asdict(state), "error": state.error.replace("\0", "\\0")}
    return {f"new_{name}": value for name, value in fields_.items()}


def _row(campaign_id: int, run: Run) -> dict[str, object]:
    return {
        "campaign_id": campaign_id,
        **run.cell._asdict(),
        "number": run.index,
        "seed": run.spec.seed,
        "spec": run.spec.model_dump_json(),
        **asdict(RunState()),
    }


def _campaign(row: Any) -> Campaign:
    try:
        spec = CampaignSpec.model_validate_json(row.spec)
    except ValidationError as error:
        message = f"{row.name}-{row.id}: stored by another version of zenfi: {one_line(error)}"
        raise BadSpecError(message) from error
    return Campaign(row.id, spec, row.phase, row.reason, row.created, row.wish)
