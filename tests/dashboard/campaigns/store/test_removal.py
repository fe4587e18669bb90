"""A deleted campaign is gone whole, whenever its deletion was interrupted, and no other suffers."""

import io
import subprocess
import sys
import time
from contextlib import closing

import pytest

from dashboard.campaigns.store import removal
from dashboard.campaigns.store.store import BusyError, Store
from deploy.errors import BadSpecError
from tests.dashboard.campaigns.store.test_store import SPEC, flown
from tests.dashboard.command import refusal, zenfi


def test_a_campaign_goes_with_its_runs_and_files(store: Store) -> None:
    doomed, other = store.create(SPEC), store.create(SPEC)
    for campaign in (doomed, other):
        flown(store, campaign, next(iter(store.planned(campaign))))
        (store.artefacts(campaign) / "run-1.json").touch()
    folder = store.artefacts(doomed)
    store.delete(doomed)
    assert [one.label for one in store.campaigns()] == ["x-2"]
    assert not folder.exists()
    assert (store.artefacts(other) / "run-1.json").exists()
    assert store.progress(doomed) == {}
    assert len(list(store.records(other))) == 6
    with pytest.raises(BadSpecError, match="no campaign"):
        store.find("x-1")
    assert store.create(SPEC).label == "x-3"


def test_the_number_of_the_last_campaign_is_not_given_again(store: Store) -> None:
    store.delete(store.create(SPEC))
    assert store.create(SPEC).label == "x-2"


def test_a_campaign_within_anothers_folder_keeps_its_files(store: Store) -> None:
    outer = store.create(SPEC)
    inner = store.create(SPEC.model_copy(update={"artefacts": "x-1"}))
    for campaign in (outer, inner):
        (store.artefacts(campaign) / "worker-0.log").touch()
    store.delete(outer)
    assert (store.artefacts(inner) / "worker-0.log").exists()


@pytest.mark.parametrize("artefacts", ["x" * 5000, "zenfi/taken"])
def test_a_campaign_whose_folder_cannot_be_made_is_deleted(store: Store, artefacts: str) -> None:
    (store.folder / "artefacts" / "zenfi").touch()
    stuck = store.create(SPEC.model_copy(update={"artefacts": artefacts}))
    with pytest.raises(BadSpecError, match="no folder for x-1") as refused:
        store.artefacts(stuck)
    assert len(str(refused.value)) < 400
    store.delete(stuck)
    store.delete(store.create(SPEC))
    assert store.campaigns() == []


def test_a_campaign_that_is_flown_is_not_deleted(store: Store, where: str) -> None:
    campaign = store.create(SPEC)
    with store.lock(campaign), closing(Store(where)) as other, pytest.raises(BusyError):
        other.delete(campaign)
    assert store.find("x-1") == campaign


def test_a_deleted_campaign_is_not_flown_by_who_knew_it_before(store: Store) -> None:
    campaign = store.create(SPEC)
    store.delete(campaign)
    with pytest.raises(BadSpecError, match="was deleted"), store.lock(campaign):
        pass


def test_what_an_interrupted_deletion_left_goes_with_the_next(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign, next_ = store.create(SPEC), store.create(SPEC)
    file = store.artefacts(campaign) / "run-1.json"
    file.touch()

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(removal, "remove", killed)
        with pytest.raises(KeyboardInterrupt):
            store.delete(campaign)
    assert [one.label for one in store.campaigns()] == ["x-2"]
    assert file.exists()
    store.delete(next_)
    assert not file.parent.exists()
    assert store.progress(campaign) == {}


DELETE = """
import sys
from dashboard.campaigns.store.store import Store
store = Store(sys.argv[1])
print("ready", flush=True)
store.delete(store.find(sys.argv[2]))
"""


@pytest.mark.soak
def test_killed_at_any_moment_it_is_there_whole_or_not_at_all(store: Store, where: str) -> None:
    big = SPEC.model_copy(update={"runs": 2000})
    for delay_ms in (0, 5, 10, 20, 40):
        campaign = store.create(big)
        planned = len(store.planned(campaign))
        (store.artefacts(campaign) / "run-1.json").touch()
        command = [sys.executable, "-c", DELETE, where, campaign.label]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(delay_ms / 1000)
            process.kill()
        if campaign.label in [one.label for one in store.campaigns()]:
            assert store.progress(campaign).total() == planned
            assert (store.artefacts(campaign) / "run-1.json").exists()
    last = store.create(SPEC)
    store.delete(last)
    for campaign in store.campaigns():
        store.delete(campaign)
    assert list((store.folder / "artefacts").iterdir()) == []


def test_the_command_wants_to_be_sure(store: Store, where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())  # nobody at a terminal
    store.create(SPEC)
    command = ("campaign", "delete", "x-1", "--store", where)
    assert "--yes" in refusal(*command)
    assert len(store.campaigns()) == 1
    assert zenfi(*command, "--yes").returncode == 0
    assert store.campaigns() == []
