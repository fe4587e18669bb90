"""Stores that earlier versions wrote are brought to the newest form, whole, and killed midway as well."""

import json
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from dashboard.campaigns.events import Begin, Flown, Leased, RunStarted
from dashboard.campaigns.results.injection_groups import InjectedFlights
from dashboard.campaigns.results.summary import summary
from dashboard.campaigns.spec import Arm, Condition
from dashboard.campaigns.store import postgresql
from dashboard.campaigns.store.backup import problems
from dashboard.campaigns.store.database import migrate
from dashboard.campaigns.store.listing import stored_run
from dashboard.campaigns.store.schema import Base
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError
from services.models.faults.specification import FaultSpec, Site, Trigger
from services.models.mission import MissionSpec
from services.models.outcome import InjectionRecord
from tests.dashboard.campaigns.store.test_store import SPEC, flown, outcome

WRITTEN = sorted((Path(__file__).parents[3] / "fixtures" / "stores").glob("*.sql"))
"""Stores as SQL, by their form: the last version that had it has written each, with one flown run of two."""


def written(dump: Path, folder: Path) -> Path:
    folder.mkdir()
    with closing(sqlite3.connect(folder / "zenfi.sqlite")) as connection:
        connection.executescript(dump.read_text())
    return folder


@pytest.mark.parametrize("dump", WRITTEN, ids=lambda dump: dump.stem)
def test_a_store_that_an_earlier_version_wrote_is_whole(dump: Path, tmp_path: Path) -> None:
    with closing(Store(written(dump, tmp_path / "store"))) as store:
        found = store.find("x-1")
        assert list(problems(store)) == []
        assert [one.result.digest for one in store.records(found) if one.result is not None] == ["d"]
        assert [(one.arm, one.runs, one.injected) for one in summary(store, found)] == [
            ("a", 0, 0),
            ("b", 1, 1),
        ]
        run = stored_run(store, found, 2)
        assert run is not None
        assert run.outcome is not None
        assert run.outcome.wall_s == 2.0
        flown(store, found, 1)  # and it is gone on with
        assert [one.runs for one in summary(store, found)] == [1, 1]


KILLED = """
import os, signal, sys
from pathlib import Path
import sqlalchemy as sa
from dashboard.campaigns.store.store import Store

@sa.event.listens_for(sa.Engine, "before_cursor_execute")
def kill(connection, cursor, statement, *_):
    if sys.argv[2] in statement:
        os.kill(os.getpid(), signal.SIGKILL)

Store(Path(sys.argv[1]))
"""


@pytest.mark.parametrize(
    "at", ["ADD COLUMN alarms", "INSERT INTO outcomes", "DROP COLUMN", "version_num='0010'"]
)
def test_killed_while_it_is_brought_up_to_date_a_store_is_as_it_was(at: str, tmp_path: Path) -> None:
    folder = written(WRITTEN[0], tmp_path / "store")
    killed = subprocess.run([sys.executable, "-c", KILLED, folder, at], check=False, timeout=600)
    assert killed.returncode == -signal.SIGKILL
    with closing(sqlite3.connect(folder / "zenfi.sqlite")) as connection:
        assert "\n".join(connection.iterdump()) + "\n" == WRITTEN[0].read_text()
    with closing(Store(folder)) as store:
        assert list(problems(store)) == []


def test_the_migrations_make_what_the_schema_says(store: Store) -> None:
    with store.database.reading() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []


def test_a_store_of_an_older_form_is_brought_up_to_date(where: str, tmp_path: Path) -> None:
    engine = raw(where, tmp_path)
    with engine.connect() as connection:
        migrate(connection, "0001")
        connection.execute(
            sa.text(
                "INSERT INTO campaigns (name, spec, phase, reason, wish, created) "
                "VALUES ('x', :spec, 'queued', '', '', '2026')"
            ),
            {"spec": SPEC.model_dump_json()},
        )
        connection.commit()
    engine.dispose()
    with closing(Store(where)) as store:
        assert [one.label for one in store.campaigns()] == ["x-1"]
        with store.database.reading() as connection:
            assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []


def test_of_flights_from_before_harm_is_not_known(where: str, tmp_path: Path) -> None:
    with closing(Store(where)) as store:
        flown(store, store.create(SPEC), 1)
    engine = raw(where, tmp_path)
    with engine.begin() as connection:
        as_in_0008(connection)
        for column in ("harm", "harmed_at_s", "proof"):
            connection.execute(sa.text(f"ALTER TABLE results DROP COLUMN {column}"))
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '0006'"))
    engine.dispose()
    with closing(Store(where)) as store:
        first = next(store.records(store.find("x-1")))
        assert first.result is not None
        assert (first.result.flight_time_s, first.result.harm, first.result.harmed_at_s) == (1.5, None, None)


DOCUMENTS = (("campaigns", "id", "spec"), ("runs", "id", "spec"), ("results", "run_id", "outcome"))
"""Table, key and column of the JSON that is stored."""


def older(document: Any) -> Any:
    """A document as form 0003 had it: a site with ``rung``, a record with ``mode``, ``scouts``."""
    if isinstance(document, list):
        return [older(one) for one in document]
    if not isinstance(document, dict):
        return document
    names = {"precision": "rung" if "steps" in document else "mode", "probes": "scouts"}
    return {names.get(key, key): older(value) for key, value in document.items()}


@pytest.mark.parametrize("of_arms", [True, False])
def test_sites_and_records_of_an_older_form_keep_their_precision(
    where: str, tmp_path: Path, *, of_arms: bool
) -> None:
    trigger = Trigger(invocation=3, site=Site(precision="occurrence", offset=1, hit=2))
    fault = FaultSpec(target="pid", trigger=trigger)
    arms = (Arm(name="a"), Arm(name="b", fault=fault if of_arms else None))
    faults = () if of_arms else (Condition(name="none"), Condition(name="pid", fault=fault))
    record = InjectionRecord(
        status="injected",
        reason='\N{GREEK SMALL LETTER MU} "mode"',
        precision="rehearsed",
        node="control",
        kernel="pid",
        invocation=3,
        trigger=trigger,
        probes=4,
    )
    flight = outcome().model_copy(update={"spec": MissionSpec(fault=fault), "injection": record})
    with closing(Store(where)) as store:
        campaign = store.create(SPEC.model_copy(update={"arms": arms, "faults": faults}))
        states, planned = store.states(campaign), store.planned(campaign)
        for event in (Begin(), Leased("l", (2,), 9.0), RunStarted("l", 2), Flown("l", 2)):
            states.handle(event)
        store.write(campaign, states, [2], {2: flight})
    engine = raw(where, tmp_path)
    with engine.begin() as connection:
        as_in_0008(connection)
        before = documents(connection)
        for (table, key, column), rows in zip(DOCUMENTS, before, strict=True):
            for number, document in rows:
                connection.execute(
                    sa.text(f"UPDATE {table} SET {column} = :text WHERE {key} = :number"),  # noqa: S608 - ours
                    {"text": json.dumps(older(document)), "number": number},
                )
        for column in ("replay", "twin_digest", "alarms", "recomputed", "harm", "harmed_at_s", "proof"):
            connection.execute(sa.text(f"ALTER TABLE results DROP COLUMN {column}"))
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '0003'"))
        assert documents(connection) != before
    with closing(Store(where)) as store:
        with engine.connect() as connection:
            assert documents(connection, outcomes="outcomes") == before
        assert store.planned(store.find("x-1")) == planned
        whole = InjectedFlights({"whole": InjectionRecord.model_dump_json})
        (group,) = whole.read(store, campaign).grouped("whole")
        assert group.name == record.model_dump_json()
    engine.dispose()


def documents(connection: sa.Connection, outcomes: str = "results") -> list[list[tuple[int, Any]]]:
    """What is stored as JSON, by table and key; outcomes are in a table of their own since form 0009."""
    found = []
    for name, key, column in DOCUMENTS:
        table = outcomes if column == "outcome" else name
        rows = connection.execute(sa.text(f"SELECT {key}, {column} FROM {table} ORDER BY {key}"))  # noqa: S608
        found.append([(number, json.loads(text)) for number, text in rows])
    return found


def as_in_0008(connection: sa.Connection) -> None:
    """Undo forms 0010 and 0009, on either database."""
    for statement in (
        "ALTER TABLE results DROP COLUMN overhead",
        "ALTER TABLE results ADD COLUMN outcome TEXT",
        "UPDATE results SET outcome = (SELECT outcome FROM outcomes WHERE outcomes.run_id = results.run_id)",
        "DROP TABLE outcomes",
        "DROP INDEX ix_runs_campaign_id_changed",
        "ALTER TABLE runs DROP COLUMN changed",
        "DROP INDEX ix_results_artefact",
        "DROP INDEX ix_results_replay",
    ):
        connection.execute(sa.text(statement))


def raw(where: str, tmp_path: Path) -> sa.Engine:
    """The database of a store that is not open."""
    if "://" in where:
        url = postgresql.parse(where)
        plain = url.set(drivername="postgresql+pg8000", query={})
        return sa.create_engine(plain, connect_args=postgresql.connect_arguments(url))
    (tmp_path / "store").mkdir(exist_ok=True)
    return sa.create_engine(f"sqlite:///{tmp_path / 'store' / 'zenfi.sqlite'}")


def test_a_store_of_a_newer_zenfi_is_left_alone(where: str, tmp_path: Path) -> None:
    with closing(Store(where)):
        pass
    engine = raw(where, tmp_path)
    with engine.begin() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '9999'"))
    engine.dispose()
    with pytest.raises(BadSpecError, match="newer"):
        Store(where)
