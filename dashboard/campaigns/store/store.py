"""Stores campaigns: a database (a SQLite file, or PostgreSQL) and a folder of artefacts.

Many processes may read. A campaign is written by the one scheduler that holds its lock, which is released
when that process ends, even if it is killed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import sqlalchemy as sa

from dashboard.campaigns.flight_record import Result
from dashboard.campaigns.recording import FileState
from dashboard.campaigns.spec import CampaignSpec, Run, runs
from dashboard.campaigns.state_machine import CampaignStates, RunState
from dashboard.campaigns.store import removal
from dashboard.campaigns.store.queries import CampaignEntry, StoreQueries
from dashboard.campaigns.store.schema import CampaignRow, OutcomeRow, ResultRow, RunRow
from deploy.errors import BadSpecError
from services.models.outcome import Outcome

_RUNS = RunRow.metadata.tables[RunRow.__tablename__]
_MOVE_RUN = (
    sa.update(_RUNS)
    .where(_RUNS.c.id == sa.bindparam("run"))
    .values(
        {
            **{column.name: sa.bindparam(f"new_{column.name}") for column in fields(RunState)},
            "changed": sa.bindparam("write"),
        }
    )
)

DesiredState = Literal["", "fly", "pause", "cancel"]
"""What the process that flies a campaign shall do; ``fly`` asks the service, which resumes after a crash."""


class BusyError(BadSpecError):
    """Another process is flying this campaign."""


class RepeatedError(BadSpecError):
    """The request has created a campaign already."""

    def __init__(self, request: str | None) -> None:
        super().__init__(f"request {request!r} has created a campaign already")


class Store(StoreQueries):
    """Creates, changes and removes campaigns; what it holds is read by :class:`StoreQueries`."""

    def limit(self, disk_mb: int) -> None:
        """Let the database grow to ``disk_mb`` and no further."""
        self.database.limit(disk_mb)

    def create(
        self, spec: CampaignSpec, desired_state: DesiredState = "", request: str | None = None
    ) -> CampaignEntry:
        """Store a campaign with all its runs, queued.

        :raises RepeatedError: if a campaign of that ``request`` is there already.
        """
        with self.database.writing() as connection:
            created = datetime.now(UTC).isoformat(timespec="seconds")
            row = {"name": spec.name, "spec": spec.model_dump_json(), "phase": "queued", "created": created}
            try:
                key = connection.execute(
                    sa.insert(CampaignRow).values(**row, reason="", wish=desired_state, request=request)
                ).inserted_primary_key
            except sa.exc.IntegrityError as error:
                raise RepeatedError(request) from error
            assert key is not None  # noqa: S101 - an insert has one
            connection.execute(sa.insert(RunRow), [_row(int(key[0]), run) for run in runs(spec)])
        return CampaignEntry(int(key[0]), spec, "queued", "", created, desired_state)

    def artefacts(self, campaign: CampaignEntry) -> Path:
        """The folder for a campaign's files, made if need be.

        :raises BadSpecError: if it cannot be made, or lies outside the folder of artefacts, by a link.
        """
        self.database.refuse_read_only()
        try:
            folder = self.folder_of(campaign.spec, campaign.label)
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            message = (
                f"artefacts: no folder for {campaign.label}: {error.strerror}: {str(error.filename)[:200]}"
            )
            raise BadSpecError(message) from error
        return folder

    def folder_of(self, spec: CampaignSpec, label: str) -> Path:
        """The folder of a campaign's files, whether it is there or not.

        :raises BadSpecError: if it lies outside the folder of artefacts, by a link.
        """
        root = (self.folder / "artefacts").resolve()
        folder = (root / spec.artefacts / label).resolve()
        if not folder.is_relative_to(root):
            message = f"artefacts: {spec.artefacts!r} leads out of {root}"
            raise BadSpecError(message)
        return folder

    def delete(self, campaign: CampaignEntry) -> None:
        """Remove a campaign with its runs, results and files; killed midway, nobody is shown what is left.

        :raises BusyError: if it is being flown.
        """
        with self.lock(campaign):
            removal.hide(self.database, campaign.id)
        self.remove_left_over()

    def remove_left_over(self) -> None:
        """Remove the rows and files that an interrupted :meth:`delete` has left."""
        for number, name, spec in removal.left_over(self.database):
            folder = self.folder_of(CampaignSpec.model_validate_json(spec), f"{name}-{number}")
            removal.remove(self.database, number, folder)

    @contextmanager
    def lock(self, campaign: CampaignEntry) -> Iterator[None]:
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

    def is_flying(self, campaign: CampaignEntry) -> bool:
        """Whether some process is flying a campaign."""
        try:
            with self.lock(campaign):
                return False
        except BusyError:
            return True

    def set_desired_state(self, campaign: CampaignEntry, desired: DesiredState) -> None:
        """Ask the process that flies a campaign to reach a state."""
        with self.database.writing() as connection:
            connection.execute(
                sa.update(CampaignRow).where(CampaignRow.id == campaign.id).values(wish=desired)
            )

    def note_replay(self, run: int, answer: str) -> None:
        """Keep what came of flying a run again: "replayed" or how it differed."""
        with self.database.writing() as connection:
            connection.execute(sa.update(ResultRow).where(ResultRow.run_id == run).values(replay=answer))

    def write(
        self,
        campaign: CampaignEntry,
        states: CampaignStates,
        changed: Sequence[int],
        flown: Mapping[int, Outcome],
        files: Mapping[int, FileState] = MappingProxyType({}),
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
                            **asdict(Result.of(outcome)),
                            "artefact": files.get(run, FileState()).fate,
                            "artefact_bytes": files.get(run, FileState()).size,
                        }
                        for run, outcome in flown.items()
                    ],
                )
                connection.execute(
                    sa.insert(OutcomeRow),
                    [
                        {"run_id": run, "outcome": outcome.model_dump_json(by_alias=True)}
                        for run, outcome in flown.items()
                    ],
                )
            moved = dict.fromkeys([*changed, *flown])
            if moved:
                last = sa.select(sa.func.max(RunRow.changed)).where(RunRow.campaign_id == campaign.id)
                write = int(connection.execute(last).scalar_one()) + 1
                rows = [{"run": run, "write": write, **_renamed(states.runs[run])} for run in moved]
                connection.execute(_MOVE_RUN, rows)
            connection.execute(
                sa.update(CampaignRow)
                .where(CampaignRow.id == campaign.id)
                .values(phase=states.phase, reason=states.reason)
            )


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
