"""The store keeps what it is given, exactly once, in the form that the migrations make."""

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from dashboard.campaigns import postgresql
from dashboard.campaigns.database import StoreFullError, migrate
from dashboard.campaigns.events import Begin, Flown, Leased, Started
from dashboard.campaigns.schema import Base
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.states import CampaignStates
from dashboard.campaigns.store import BusyError, Campaign, Store
from deploy.check import BadSpecError
from services.bus.mission import FaultSpec, MissionSpec
from services.bus.outcome import NO_FLIGHT, InjectionRecord, NodeReport, Outcome

SPEC = CampaignSpec(name="x", runs=3, arms=(Arm(name="a"), Arm(name="b", fault=FaultSpec(target="pid"))))


def outcome(digest: str = "d") -> Outcome:
    return Outcome(
        spec=MissionSpec(),
        result="timeout",
        qof=NO_FLIGHT.model_copy(update={"flight_time_s": 1.5}),
        digest=digest,
        wall_s=2.0,
        nodes={"control": NodeReport(result="sdc")},
        topics={},
        injection=InjectionRecord(status="injected", node="control", kernel="pid", invocation=1),
    )


def flown(store: Store, campaign: Campaign, run: int) -> CampaignStates:
    """Write one flown run."""
    states = store.states(campaign)
    for event in (Begin(), Leased("l", (run,), 9.0), Started("l", run), Flown("l", run)):
        states.handle(event)
    store.write(campaign, states, [run], {run: outcome()})
    return states


def test_a_campaign_is_stored_with_its_runs(store: Store) -> None:
    campaign = store.create(SPEC)
    assert campaign.label == "x-1"
    assert store.create(SPEC).label == "x-2"
    assert store.find("x-1") == store.find("1") == campaign
    assert [run.cell for run in store.planned(campaign).values()] == [
        ("a", "sparse", ""),
        ("b", "sparse", ""),
    ] * 3
    assert store.states(campaign).count("queued") == 6
    for label in ("x-9", "y-1", "x", ""):
        with pytest.raises(BadSpecError, match="no campaign"):
            store.find(label)


def test_a_result_is_read_back_as_it_was_written(store: Store) -> None:
    campaign = store.create(SPEC)
    flown(store, campaign, 1)
    first, *others = store.records(campaign)
    assert first.phase == "done"
    assert first.result is not None
    assert (first.result.flight_time_s, first.result.digest) == (1.5, "d")
    assert (first.result.injection, first.result.node, first.result.node_result) == (
        "injected",
        "control",
        "sdc",
    )
    assert [other.result for other in others] == [None] * 5
    assert store.find("x-1").phase == "running"
    assert store.progress(campaign) == {"done": 1, "queued": 5}


def test_a_second_result_of_a_run_is_refused_by_the_database(store: Store) -> None:
    campaign = store.create(SPEC)
    states = flown(store, campaign, 1)
    with pytest.raises(sa.exc.IntegrityError):
        store.write(campaign, states, [], {1: outcome("other")})
    assert [one.result.digest for one in store.records(campaign) if one.result is not None] == ["d"]


def test_state_and_result_are_written_together_or_not_at_all(store: Store) -> None:
    campaign = store.create(SPEC)
    states = flown(store, campaign, 1)
    for event in (Leased("m", (2,), 9.0), Started("m", 2), Flown("m", 2)):
        states.handle(event)
    with pytest.raises(sa.exc.IntegrityError):
        store.write(campaign, states, [2], {2: outcome(), 1: outcome()})
    assert store.states(campaign).runs[2].phase == "queued"


def test_only_one_may_fly_a_campaign(store: Store) -> None:
    campaign = store.create(SPEC)
    assert not store.is_flying(campaign)
    with store.lock(campaign):
        assert store.is_flying(campaign)
        with pytest.raises(BusyError, match="x-1"), store.lock(campaign):
            pass
    assert not store.is_flying(campaign)


def test_a_full_store_says_so_and_keeps_what_it_has(store: Store) -> None:
    campaign = store.create(SPEC)
    flown(store, campaign, 1)
    store.limit(1)
    big = outcome("x" * 2_000_000)
    with pytest.raises(StoreFullError, match="full"):
        store.write(campaign, store.states(campaign), [], {2: big})
    assert [one.phase for one in store.records(campaign)] == ["done"] + ["queued"] * 5


FULL_DISK = """
import pathlib, sys
sys.path.insert(0, {root!r})
from dashboard.campaigns.database import StoreFullError
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store import Store
store = Store(pathlib.Path({folder!r}))
try:
    while True:
        store.create(CampaignSpec(name="x", runs=200, arms=(Arm(name="a"),)))
except StoreFullError as error:
    print(error)
print(len(store.campaigns()) > 0)
"""


def test_a_really_full_disk_is_told_as_such(tmp_path: Path) -> None:
    root = str(Path(__file__).parents[3])
    script = FULL_DISK.format(root=root, folder=str(tmp_path / "small"))
    (tmp_path / "small").mkdir()
    (tmp_path / "fill.py").write_text(script)
    mounted = 'mount -t tmpfs -o size=2m none "$1" && exec "$2" "$3"'
    arguments = [str(tmp_path / "small"), sys.executable, str(tmp_path / "fill.py")]
    command = ["unshare", "--map-root-user", "--mount", "sh", "-c", mounted, "sh", *arguments]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    if answer.stderr.startswith(("unshare", "mount")):
        pytest.skip(f"no private file systems here: {answer.stderr.strip()}")
    assert answer.stdout.splitlines()[0].endswith("database or disk is full"), answer.stderr
    assert answer.stdout.splitlines()[1] == "True"


def test_artefacts_stay_inside(store: Store, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (store.folder / "artefacts" / "out").symlink_to(tmp_path / "elsewhere")
    campaign = store.create(SPEC.model_copy(update={"artefacts": "out/there"}))
    with pytest.raises(BadSpecError, match="leads out"):
        store.artefacts(campaign)
    assert store.artefacts(store.create(SPEC)).name == "x-2"


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


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    (tmp_path / "zenfi.sqlite").write_text("something else, long enough to be looked at" * 100)
    with pytest.raises(BadSpecError, match="not a database"):
        Store(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(BadSpecError, match="--store"):
        Store(tmp_path / "file" / "store")
