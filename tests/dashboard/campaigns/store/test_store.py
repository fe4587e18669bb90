"""The store keeps what it is given, exactly once, in the form that the migrations make."""

import json
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
import sqlalchemy as sa

from dashboard.campaigns.events import Begin, Flown, Leased, RunStarted
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.state_machine import CampaignStates
from dashboard.campaigns.store.database import StoreFullError, StoreLostError
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import BusyError, Store
from deploy.errors import BadSpecError
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.oracles.harm import HarmEvent
from services.models.outcome import NO_FLIGHT, InjectionRecord, NodeReport, Outcome
from tests.dashboard.command import zenfi

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
        harm=[HarmEvent(kind="too_slow", at_ns=1_250_000_000)],
    )


def flown(store: Store, campaign: CampaignEntry, run: int) -> CampaignStates:
    """Write one flown run."""
    states = store.states(campaign)
    for event in (Begin(), Leased("l", (run,), 9.0), RunStarted("l", run), Flown("l", run)):
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
    assert (first.result.harm, first.result.harmed_at_s) == ("too_slow", 1.25)
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
    for event in (Leased("m", (2,), 9.0), RunStarted("m", 2), Flown("m", 2)):
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
from dashboard.campaigns.store.database import StoreFullError
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.store import Store
store = Store(pathlib.Path({folder!r}))
try:
    while True:
        store.create(CampaignSpec(name="x", runs=200, arms=(Arm(name="a"),)))
except StoreFullError as error:
    print(error)
print(len(store.campaigns()) > 0)
"""


def test_a_really_full_disk_is_told_as_such(tmp_path: Path) -> None:
    root = str(Path(__file__).parents[4])
    script = FULL_DISK.format(root=root, folder=str(tmp_path / "small"))
    (tmp_path / "small").mkdir()
    (tmp_path / "fill.py").write_text(script)
    mounted = 'mount -t tmpfs -o size=2m none "$1" && exec "$2" "$3"'
    arguments = [str(tmp_path / "small"), sys.executable, str(tmp_path / "fill.py")]
    command = ["unshare", "--map-root-user", "--mount", "sh", "-c", mounted, "sh", *arguments]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
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


def test_a_store_is_its_users_alone(tmp_path: Path) -> None:
    folder = tmp_path / "made"
    with closing(Store(folder)) as store:
        store.create(SPEC)
        assert len(list(folder.iterdir())) >= 4
        for path in (folder, *folder.iterdir()):
            assert not path.stat().st_mode & 0o077, path


def test_a_file_that_is_gone_or_another_is_neither_read_nor_written(tmp_path: Path) -> None:
    file, away = tmp_path / "zenfi.sqlite", tmp_path / "away"
    with closing(Store(tmp_path)) as store:
        kept = store.create(SPEC)
        file.rename(away)
        for another in (False, True):
            if another:
                file.touch()
            with pytest.raises(StoreLostError, match="removed or replaced"):
                store.find(kept.label)
            with pytest.raises(StoreLostError, match="removed or replaced"):
                store.create(SPEC)
            assert file.exists() == another
        away.rename(file)
        assert [one.label for one in store.campaigns()] == [kept.label]


def test_what_was_written_into_a_file_that_goes_meanwhile_was_not_written(tmp_path: Path) -> None:
    with closing(Store(tmp_path)) as store:
        writing = store.database.writing()
        writing.__enter__().execute(sa.text("DELETE FROM campaigns"))
        (tmp_path / "zenfi.sqlite").unlink()
        with pytest.raises(StoreLostError):
            writing.__exit__(None, None, None)


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    (tmp_path / "zenfi.sqlite").write_text("something else, long enough to be looked at" * 100)
    with pytest.raises(BadSpecError, match="not a database"):
        Store(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(BadSpecError, match="--store"):
        Store(tmp_path / "file" / "store")


def test_beside_a_store_whose_file_is_away_none_is_made(tmp_path: Path) -> None:
    """SQLite would remove what was written last, which is in a file of its own, with the new one."""
    file, away = tmp_path / "zenfi.sqlite", tmp_path / "away"
    with closing(Store(tmp_path)) as store:
        kept = store.create(SPEC).label
        file.rename(away)
        answer = zenfi("campaign", "list", "--store", tmp_path)
        assert (answer.returncode, answer.stdout) == (2, "")
        assert "zenfi.sqlite-wal" in answer.stderr
        assert not file.exists()
        away.rename(file)
        answer = zenfi("campaign", "list", "--store", tmp_path, "--json")
        assert json.loads(answer.stdout)["campaign"] == kept


def test_a_file_that_goes_while_it_is_opened_is_not_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(Store(tmp_path)) as store:
        store.database.close()
        monkeypatch.setattr(store.database, "_refuse_another_file", lambda: None)  # it had looked before
        (tmp_path / "zenfi.sqlite").unlink()
        with pytest.raises(StoreLostError, match="removed or replaced"):
            store.campaigns()
        assert not (tmp_path / "zenfi.sqlite").exists()
