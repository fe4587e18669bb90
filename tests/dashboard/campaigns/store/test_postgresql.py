"""What a store on PostgreSQL promises beyond what every store does."""

import json
import ssl
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest
import sqlalchemy as sa

from dashboard.campaigns.events import Begin, Flown, Leased, RunStarted
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store import postgresql
from dashboard.campaigns.store.database import StoreFullError, StoreLostError
from dashboard.campaigns.store.store import BusyError, Store
from deploy.errors import BadSpecError
from services.models.mission import MissionSpec
from tests.dashboard.campaigns.store.test_store import SPEC, outcome
from tests.dashboard.command import refusal, zenfi
from tests.fixtures.postgresql import PASSWORD, Server

SHORT = """
name = "short"
runs = 1
mission = { limits = { mission_time_s = 0.6 } }
arms = [{ name = "golden" }]
"""
KICK_OUT = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = 'zenfi'"


@pytest.fixture
def url(postgresql_server: Server) -> str:
    return postgresql_server.database()


def test_a_campaign_has_one_writer_whoever_asks(url: str) -> None:
    with closing(Store(url)) as ours, closing(Store(url)) as theirs:
        campaign = ours.create(SPEC)
        with ours.lock(campaign):
            assert theirs.is_flying(campaign)
            with pytest.raises(BusyError, match="x-1"), theirs.lock(campaign):
                pass
            assert ours.is_flying(campaign)
        with theirs.lock(campaign):
            pass


def test_who_loses_the_lock_can_write_no_more(url: str, postgresql_server: Server) -> None:
    with closing(Store(url)) as store, closing(Store(url)) as other:
        campaign = store.create(SPEC)
        states = store.states(campaign)
        for event in (Begin(), Leased("l", (1,), 9.0), RunStarted("l", 1), Flown("l", 1)):
            states.handle(event)
        with store.lock(campaign):
            postgresql_server.execute(KICK_OUT)
            with other.lock(campaign):  # somebody else flies it now
                for _ in range(2):
                    with pytest.raises(StoreLostError):
                        store.write(campaign, states, [1], {1: outcome()})
        assert store.states(campaign).runs[1].phase == "queued"
        with store.lock(campaign):  # and a new session is as good as any
            store.write(campaign, states, [1], {1: outcome()})
        assert store.states(campaign).runs[1].phase == "done"


@pytest.mark.soak
def test_readers_whose_sessions_end_at_any_moment_are_told_so(url: str, postgresql_server: Server) -> None:
    with closing(Store(url)) as store, ThreadPoolExecutor() as pool:
        store.create(SPEC)

        def read() -> Counter[str]:
            told: Counter[str] = Counter()
            for _ in range(100):
                try:
                    told[store.find("1").label] += 1
                except StoreLostError:
                    told["lost"] += 1
            return told

        reading = [pool.submit(read) for _ in range(4)]
        while not all(one.done() for one in reading):
            postgresql_server.execute(KICK_OUT)
        told = sum((one.result() for one in reading), Counter[str]())
    assert told["lost"]
    assert told["lost"] + told["x-1"] == 400


def test_a_disk_that_is_full_is_told_as_such(url: str) -> None:
    with closing(Store(url)) as store:
        full = "DO $$ BEGIN RAISE EXCEPTION 'no space left on device' USING ERRCODE = 'disk_full'; END $$"
        with pytest.raises(StoreFullError, match="no space left"), store.database.writing() as connection:
            connection.execute(sa.text(full))
        assert store.campaigns() == []


def test_seeds_use_all_of_their_32_bits(url: str) -> None:
    with closing(Store(url)) as store:
        mission = MissionSpec(seed=2**32 - 3)
        campaign = store.create(CampaignSpec(name="x", runs=2, mission=mission, arms=(Arm(name="a"),)))
        assert [record.seed for record in store.records(campaign)] == [2**32 - 3, 2**32 - 2]


@pytest.mark.soak
def test_a_second_campaign_is_forecast_from_the_first(url: str, tmp_path: Path) -> None:
    file = tmp_path / "short.toml"
    file.write_text(SHORT)
    for number in (1, 2):
        answer = zenfi("campaign", "run", file, "--store", url, "--slots", 1, "--json")
        assert answer.returncode == 0, answer.stderr
        told = json.loads(answer.stdout.splitlines()[0])
        assert (told["campaign"], told["forecast"]["measured"]) == (f"short-{number}", number == 2)


def test_means_and_sums_are_no_decimals(url: str) -> None:
    with closing(Store(url)) as store, store.reading() as connection:
        for kind in (sa.SmallInteger, sa.Integer, sa.BigInteger, sa.Float):
            for reckoned in (sa.func.avg, sa.func.sum):
                value = connection.execute(sa.select(reckoned(sa.cast(3, kind)))).scalar_one()
                assert (type(value) in (int, float), value) == (True, 3), (kind, reckoned)


def test_the_words_of_a_dying_process_may_hold_anything(url: str) -> None:
    with closing(Store(url)) as store:
        campaign = store.create(SPEC)
        states = store.states(campaign)
        states._change([1], phase="failed", error="it said \0\x01")
        store.write(campaign, states, [1], {})
        assert next(store.records(campaign)).error == "it said \\0\x01"


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("mysql://me:s3cret@host/db", "expected a folder"),
        ("postgresql+psycopg2://me:s3cret@host/db", "expected a folder"),
        ("postgresql://me:s3cret@host:many/db", "expected a folder"),
        ("postgresql://me:s3cret@host", "no database"),
        ("postgresql://me:s3cret@/db", "no host"),
        ("postgresql://me:s3cret@host/db?wings=2", "unknown 'wings'"),
        ("postgresql://me:s3cret@host/db?sslmode=maybe", "sslmode"),
        ("postgresql://me:s3cret@host/db?sslrootcert=/nowhere", "sslrootcert"),
        ("postgresql://me:s3cret@localhost:1/db", "localhost:1/db: Connection refused"),
        ("postgresql://me:s3cret@/db?host=/nowhere", "/nowhere: No such file"),
    ],
)
def test_a_bad_url_is_one_line_without_its_password(given: str, says: str) -> None:
    said = refusal("campaign", "list", "--store", given)
    assert says in said
    assert "s3cret" not in said


def test_a_wrong_password_is_not_repeated(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadSpecError, match="authentication failed") as refusal:
        Store(url.replace(PASSWORD, "guessed"))
    assert "guessed" not in str(refusal.value)
    monkeypatch.setenv("PGPASSWORD", PASSWORD)
    with closing(Store(url.replace(f":{PASSWORD}", ""))) as store:
        assert PASSWORD not in store.place
        with pytest.raises(BadSpecError) as unknown:
            store.find("x-9")
    assert store.place in str(unknown.value)


def test_beyond_this_machine_the_server_must_prove_who_it_is() -> None:
    far = postgresql.connect_arguments(postgresql.parse("postgresql://me@laboratory/db"))
    assert far["ssl_context"].verify_mode == ssl.CERT_REQUIRED
    assert far["ssl_context"].check_hostname
    near = postgresql.connect_arguments(postgresql.parse("postgresql://me@127.0.0.1/db"))
    off = postgresql.connect_arguments(postgresql.parse("postgresql://me@laboratory/db?sslmode=disable"))
    assert "ssl_context" not in near
    assert "ssl_context" not in off
