"""Copies of a store that are whole, also while campaigns fly; and whether a store is sound.

A copy has the database and the files of the campaigns, and is a store by itself. What can be made again
(flown classes) and what is secret (the token) is not in it.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import sqlalchemy as sa
from pydantic import ValidationError

from dashboard.campaigns.spec import CampaignSpec
from dashboard.campaigns.store.queries import DATABASE_FILE
from dashboard.campaigns.store.schema import CampaignRow, OutcomeRow, ResultRow, RunRow
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError, one_line
from services.models.mission import MissionSpec
from services.models.outcome import Outcome

MOST_PROBLEMS = 100
"""Of a store that is not sound, so many are told."""


def back_up(store: Store, target: Path) -> None:
    """Copy a store into a new folder. Results that are written meanwhile may be in the copy or not.

    :raises BadSpecError: if the folder is there, or the store is at a PostgreSQL server.
    """
    if store.database.engine.dialect.name != "sqlite":
        message = f"{store.place}: a server's store is backed up by pg_dump; its files are in {store.folder}"
        raise BadSpecError(message)
    with _made_whole(target) as draft:
        # The database first: whatever file it names is there when files are copied.
        with store.reading() as connection:
            connection.execute(sa.text("VACUUM INTO :file"), {"file": str(draft / DATABASE_FILE)})
        (draft / DATABASE_FILE).chmod(0o600)
        shutil.copytree(
            store.folder / "artefacts", draft / "artefacts", symlinks=True, copy_function=_copy_if_there
        )


def restore(source: Path, target: Path) -> None:
    """Make a store of a copy, at a place where there is none.

    :raises BadSpecError: if the copy is not sound, or there is a store already.
    """
    if not (source / DATABASE_FILE).is_file():
        message = f"{source}: there is no {DATABASE_FILE} in it, so it is no copy of a store"
        raise BadSpecError(message)
    with closing(Store(source)) as copy:
        if problem := next(problems(copy), None):
            message = f"{source}: {problem}"
            raise BadSpecError(message)
        back_up(copy, target)


def problems(store: Store) -> Iterator[str]:
    """What is wrong with a store: its database, what is kept of each run, and files that are missing."""
    with store.reading() as connection:
        if connection.dialect.name == "sqlite":
            for check in ("integrity_check", "foreign_key_check"):
                rows = connection.execute(sa.text(f"PRAGMA {check}"))
                yield from (f"database: {row[0]}" for row in rows if row[0] != "ok")
        query = sa.select(CampaignRow.id, CampaignRow.name, CampaignRow.spec)
        campaigns = connection.execute(query.where(CampaignRow.deleted == "")).all()
    for number, name, text in campaigns:
        try:
            spec = CampaignSpec.model_validate_json(text)
        except ValidationError as error:
            yield f"{name}-{number}: {one_line(error)}"
            continue
        yield from _problems_of(store, number, store.folder_of(spec, f"{name}-{number}"))


def _problems_of(store: Store, number: int, folder: Path) -> Iterator[str]:
    """What is wrong with the runs of a campaign whose files are in ``folder``."""
    query = (
        sa.select(RunRow.id, RunRow.phase, RunRow.spec, OutcomeRow.outcome, ResultRow.artefact)
        .join(ResultRow, ResultRow.run_id == RunRow.id, isouter=True)
        .join(OutcomeRow, OutcomeRow.run_id == ResultRow.run_id, isouter=True)
        .where(RunRow.campaign_id == number)
        .order_by(RunRow.id)
        .execution_options(yield_per=500)
    )
    with store.reading() as connection:
        for run, phase, spec, outcome, files in connection.execute(query):
            where = f"{folder.name}, run {run}"
            if (phase == "done") != (outcome is not None):
                yield f"{where}: it is {phase} and has {'no' if outcome is None else 'a'} result"
            try:
                MissionSpec.model_validate_json(spec)
                if outcome is not None:
                    Outcome.model_validate_json(outcome)
            except ValidationError as error:
                yield f"{where}: {one_line(error)}"
            if files == "kept" and not (folder / f"run-{run}.json").is_file():
                yield f"{where}: its file {folder / f'run-{run}.json'} is missing"


@contextmanager
def _made_whole(target: Path) -> Iterator[Path]:
    """A new folder beside ``target``, which takes its name when it is whole, and is removed if it never is.

    :raises BadSpecError: if ``target`` is there, or cannot be made.
    """
    if target.exists():
        message = f"{target}: it is there already: name a folder that is to be made"
        raise BadSpecError(message)
    draft = target.with_name(f".{target.name}.part")
    try:
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(mode=0o700, parents=True)
        yield draft
        draft.rename(target)
    except OSError as error:  # shutil's are, too
        message = f"{target}: {error.strerror or error}"
        raise BadSpecError(message) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _copy_if_there(source: str, target: str) -> None:
    """Copy a file, unless the flight that it belongs to has just dropped it."""
    with suppress(FileNotFoundError):
        shutil.copy2(source, target, follow_symlinks=False)
