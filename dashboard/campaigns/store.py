"""Where campaigns live: one SQLite file with a folder of artefacts beside it.

Many may read; a campaign is written by the one scheduler that holds its lock, which the kernel frees
when that process ends, however it ends.
"""

from __future__ import annotations

import fcntl
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from pydantic import ValidationError

from dashboard.campaigns.database import Database
from dashboard.campaigns.records import Record, Result
from dashboard.campaigns.schema import CampaignRow, ResultRow, RunRow
from dashboard.campaigns.spec import CampaignSpec, Cell, Run, runs
from dashboard.campaigns.states import CampaignPhase, CampaignStates, RunState
from deploy.check import BadSpecError, one_line
from services.bus.mission import MissionSpec
from services.bus.outcome import Outcome

_COLUMNS = [column.name for column in fields(Result)]
_RUNS = RunRow.metadata.tables[RunRow.__tablename__]
_MOVE_RUN = (
    sa.update(_RUNS)
    .where(_RUNS.c.id == sa.bindparam("run"))
    .values({column.name: sa.bindparam(f"new_{column.name}") for column in fields(RunState)})
)


class BusyError(BadSpecError):
    """Another process is flying this campaign."""


@dataclass(frozen=True, slots=True)
class Campaign:
    """A campaign as stored; ``label`` is what people call it."""

    id: int
    spec: CampaignSpec
    phase: CampaignPhase
    reason: str
    created: str

    @property
    def label(self) -> str:
        """Its name and number."""
        return f"{self.spec.name}-{self.id}"


def default_folder() -> Path:
    """``ZENFI_HOME``, or the user's folder for data."""
    home = os.environ.get("ZENFI_HOME")
    return Path(home) if home else Path.home() / ".local" / "share" / "zenfi"


class Store:
    """Opens the store in ``folder``, made or brought up to date if need be.

    :raises BadSpecError: if that cannot be.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            (folder / "artefacts").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            message = f"store {folder}: {error.strerror}; choose another with --store or ZENFI_HOME"
            raise BadSpecError(message) from error
        self._database = Database(folder / "zenfi.sqlite")

    def close(self) -> None:
        """Close every connection."""
        self._database.close()

    def limit(self, disk_mb: int) -> None:
        """Let the database grow to ``disk_mb`` and no further."""
        self._database.limit(disk_mb)

    # -- campaigns ---------------------------------------------------------------------------------

    def create(self, spec: CampaignSpec) -> Campaign:
        """Store a campaign with all its runs, queued."""
        with self._database.writing() as connection:
            created = datetime.now(UTC).isoformat(timespec="seconds")
            row = {"name": spec.name, "spec": spec.model_dump_json(), "phase": "queued", "created": created}
            key = connection.execute(
                sa.insert(CampaignRow).values(**row, reason="", wish="")
            ).inserted_primary_key
            assert key is not None  # noqa: S101 - an insert has one
            connection.execute(sa.insert(RunRow), [_row(int(key[0]), run) for run in runs(spec)])
        return Campaign(int(key[0]), spec, "queued", "", created)

    def campaigns(self) -> list[Campaign]:
        """All of them, the oldest first."""
        with self._database.reading() as connection:
            return [_campaign(row) for row in connection.execute(sa.select(CampaignRow.__table__))]

    def find(self, label: str) -> Campaign:
        """The campaign of that label or number.

        :raises BadSpecError: if there is none.
        """
        name, _, number = label.rpartition("-")
        if number.isdecimal():
            with self._database.reading() as connection:
                query = sa.select(CampaignRow.__table__).where(CampaignRow.id == int(number))
                row = connection.execute(query).first()
            if row is not None and name in ("", row.name):
                return _campaign(row)
        message = f"no campaign {label!r} in {self.folder}: see zenfi campaign list"
        raise BadSpecError(message)

    def artefacts(self, campaign: Campaign) -> Path:
        """The folder for a campaign's files, made if need be.

        :raises BadSpecError: if it lies outside the store's folder of artefacts, by a link.
        """
        root = (self.folder / "artefacts").resolve()
        folder = (root / (campaign.spec.artefacts or campaign.label)).resolve()
        if not folder.is_relative_to(root):
            message = f"artefacts: {campaign.spec.artefacts!r} leads out of {root}"
            raise BadSpecError(message)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    @contextmanager
    def lock(self, campaign: Campaign) -> Iterator[None]:
        """Be the only one that writes to a campaign.

        :raises BusyError: if somebody else is.
        """
        descriptor = os.open(
            self.folder / f"{campaign.id}.lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600
        )
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                message = f"{campaign.label} is being flown by another process"
                raise BusyError(message) from error
            yield
        finally:
            os.close(descriptor)

    def is_flying(self, campaign: Campaign) -> bool:
        """Whether some process is flying a campaign."""
        try:
            with self.lock(campaign):
                return False
        except BusyError:
            return True

    def wish(self, campaign: Campaign, what: str) -> None:
        """Ask the process that flies a campaign for something."""
        with self._database.writing() as connection:
            connection.execute(sa.update(CampaignRow).where(CampaignRow.id == campaign.id).values(wish=what))

    def wished(self, campaign: Campaign) -> str:
        """What was asked for."""
        with self._database.reading() as connection:
            query = sa.select(CampaignRow.wish).where(CampaignRow.id == campaign.id)
            return str(connection.execute(query).scalar_one())

    # -- runs --------------------------------------------------------------------------------------

    def states(self, campaign: Campaign) -> CampaignStates:
        """Where a campaign and its runs stand."""
        query = sa.select(RunRow.id, RunRow.phase, RunRow.attempts, RunRow.lease, RunRow.error)
        with self._database.reading() as connection:
            rows = connection.execute(query.where(RunRow.campaign_id == campaign.id).order_by(RunRow.id))
            found = {row.id: RunState(row.phase, row.attempts, row.lease, row.error) for row in rows}
        return CampaignStates(found, campaign.spec.limits.attempts, campaign.phase, campaign.reason)

    def planned(self, campaign: Campaign) -> dict[int, Run]:
        """Every run by its id, in the order of planning."""
        query = sa.select(RunRow.id, RunRow.arm, RunRow.number, RunRow.spec, RunRow.fault)
        with self._database.reading() as connection:
            rows = connection.execute(query.where(RunRow.campaign_id == campaign.id).order_by(RunRow.id))
            return {
                row.id: Run(row.arm, row.number, MissionSpec.model_validate_json(row.spec), row.fault)
                for row in rows
            }

    def write(
        self, campaign: Campaign, states: CampaignStates, changed: Sequence[int], flown: Mapping[int, Outcome]
    ) -> None:
        """Changed states and their results, together or not at all.

        :raises StoreFullError: and nothing is written.
        """
        with self._database.writing() as connection:
            if flown:
                connection.execute(
                    sa.insert(ResultRow),
                    [
                        {
                            "run_id": run,
                            "outcome": outcome.model_dump_json(by_alias=True),
                            **asdict(Result.of(outcome)),
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
        with self._database.reading() as connection:
            rows = connection.execute(query.where(RunRow.campaign_id == campaign.id))
            return Counter({row[0]: row[1] for row in rows})

    # -- reading -----------------------------------------------------------------------------------

    def records(self, campaign: Campaign) -> Iterator[Record]:
        """Every run with its result, in the order of planning."""
        query = (
            sa.select(RunRow.__table__, *(getattr(ResultRow, name) for name in _COLUMNS))
            .join(ResultRow, ResultRow.run_id == RunRow.id, isouter=True)
            .where(RunRow.campaign_id == campaign.id)
            .order_by(RunRow.id)
        )
        with self._database.reading() as connection:
            for row in connection.execute(query):
                result = (
                    Result(**{name: getattr(row, name) for name in _COLUMNS})
                    if row.result is not None
                    else None
                )
                cell = Cell(row.arm, row.world, row.fault)
                yield Record(cell, row.number, row.seed, row.phase, row.attempts, row.error, result)

    def outcome_size(self) -> float | None:
        """Mean bytes of a stored outcome."""
        return self._mean(sa.func.length(ResultRow.outcome))

    def wall_s(self, worlds: Sequence[str]) -> float | None:
        """Mean wall time of a flight in any of ``worlds``, of all campaigns."""
        return self._mean(ResultRow.wall_s, RunRow.world.in_(worlds))

    def _mean(self, column: Any, *where: Any) -> float | None:
        query = sa.select(sa.func.avg(column)).join(RunRow, RunRow.id == ResultRow.run_id).where(*where)
        with self._database.reading() as connection:
            return connection.execute(query).scalar()


def _renamed(state: RunState) -> dict[str, object]:
    return {f"new_{name}": value for name, value in asdict(state).items()}


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
    return Campaign(row.id, spec, row.phase, row.reason, row.created)
