"""A store is copied whole, also while it is written to, put back, and what is damaged is told."""

import json
import shutil
import threading
from contextlib import closing
from pathlib import Path

import pytest
import sqlalchemy as sa
from click.testing import CliRunner

from dashboard.campaigns.events import Flown, Leased, RunStarted
from dashboard.campaigns.recording import FileState
from dashboard.campaigns.store.backup import back_up, problems, restore
from dashboard.campaigns.store.store import Store
from dashboard.cli import zenfi
from deploy.errors import BadSpecError
from tests.dashboard.campaigns.store.test_store import SPEC, flown, outcome


@pytest.fixture
def here(tmp_path: Path) -> Path:
    """A store with a campaign, one of whose runs is flown and has a file."""
    with closing(Store(tmp_path / "here")) as store:
        campaign = store.create(SPEC)
        states = flown(store, campaign, 1)
        for event in (Leased("l", (2,), 9.0), RunStarted("l", 2), Flown("l", 2)):
            states.handle(event)
        store.write(campaign, states, [2], {2: outcome("e")}, {2: FileState("kept", 2)})
        (store.artefacts(campaign) / "run-2.json").write_text("{}")
    return tmp_path / "here"


def told(folder: Path) -> list[str]:
    with closing(Store(folder)) as store:
        return list(problems(store))


def test_a_copy_is_a_store_and_can_be_put_back(here: Path, tmp_path: Path) -> None:
    with closing(Store(here)) as store:
        back_up(store, tmp_path / "copy")
        store.delete(store.find("1"))
    restore(tmp_path / "copy", tmp_path / "again")
    for folder in (tmp_path / "copy", tmp_path / "again"):
        assert told(folder) == []
        with closing(Store(folder)) as store:
            (campaign,) = store.campaigns()
            assert campaign.spec == SPEC
            assert [record.result.digest for record in store.records(campaign) if record.result] == ["d", "e"]
            assert (store.artefacts(campaign) / "run-2.json").read_text() == "{}"
        for path in (folder, *folder.iterdir()):
            assert not path.stat().st_mode & 0o077, path


def test_a_copy_that_is_made_while_results_are_written_is_sound(here: Path, tmp_path: Path) -> None:
    ended = threading.Event()

    def write() -> None:
        with closing(Store(here)) as writing:
            while not ended.is_set():
                flown(writing, writing.create(SPEC), 6 * len(writing.campaigns()) - 5)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        with closing(Store(here)) as store:
            for number in range(5):
                back_up(store, tmp_path / f"copy-{number}")
    finally:
        ended.set()
        thread.join()
    for number in range(5):
        assert told(tmp_path / f"copy-{number}") == []


def test_a_file_that_is_dropped_while_it_is_copied_does_not_matter(
    here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = shutil.copy2

    def dropped(source: str, target: str, *, follow_symlinks: bool) -> None:
        if source.endswith("run-1.json"):
            Path(source).unlink()
        copy(source, target, follow_symlinks=follow_symlinks)

    monkeypatch.setattr(shutil, "copy2", dropped)
    with closing(Store(here)) as store:
        back_up(store, tmp_path / "copy")
    files = [path.name for path in (tmp_path / "copy" / "artefacts" / "x-1").iterdir()]
    assert files == ["run-2.json"]


def test_of_a_copy_that_cannot_be_finished_nothing_is_left(here: Path, tmp_path: Path) -> None:
    shutil.rmtree(here / "artefacts")
    with closing(Store(here)) as store:
        shutil.rmtree(here / "artefacts")
        with pytest.raises(BadSpecError, match="copy: No such file"):
            back_up(store, tmp_path / "copy")
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


def test_nothing_is_overwritten(here: Path, tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with closing(Store(here)) as store, pytest.raises(BadSpecError, match="there already"):
        back_up(store, tmp_path / "there")
    with pytest.raises(BadSpecError, match="there already"):
        restore(here, tmp_path / "there")
    with pytest.raises(BadSpecError, match=r"no zenfi\.sqlite in it"):
        restore(tmp_path / "there", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_what_is_damaged_is_told_and_not_put_back(here: Path, tmp_path: Path) -> None:
    assert told(here) == []
    with closing(Store(here)) as store, store.database.writing() as connection:
        connection.execute(sa.text("UPDATE outcomes SET outcome = '{}' WHERE run_id = 1"))
        connection.execute(sa.text("UPDATE runs SET phase = 'done' WHERE id = 3"))
    shutil.rmtree(here / "artefacts" / "x-1")
    found = told(here)
    assert [problem.split(":")[0] for problem in found] == ["x-1, run 1", "x-1, run 2", "x-1, run 3"]
    assert "is missing" in found[1]
    assert "it is done and has no result" in found[2]
    with pytest.raises(BadSpecError, match="run 1"):
        restore(here, tmp_path / "new")


def test_a_file_whose_pages_are_damaged_is_told(here: Path) -> None:
    file = here / "zenfi.sqlite"
    content = bytearray(file.read_bytes())
    half = len(content) // 2
    content[half : half + 4096] = bytes(4096)
    file.write_bytes(content)
    told_ = CliRunner().invoke(zenfi, ["store", "check", "--store", str(here), "--json"])
    assert told_.exit_code in (1, 2)
    assert "problem" in told_.stdout or told_.exception is not None


def test_the_commands_copy_check_and_put_back(here: Path, tmp_path: Path) -> None:
    run = CliRunner().invoke
    assert run(zenfi, ["store", "check", "--store", str(here)]).exit_code == 0
    assert run(zenfi, ["store", "backup", str(tmp_path / "copy"), "--store", str(here)]).exit_code == 0
    put_back = ["store", "restore", str(tmp_path / "copy"), "--store", str(tmp_path / "new")]
    assert run(zenfi, put_back).exit_code == 0
    (tmp_path / "new" / "artefacts" / "x-1" / "run-2.json").unlink()
    checked = run(zenfi, ["store", "check", "--store", str(tmp_path / "new"), "--json"])
    assert checked.exit_code == 1
    assert "run-2.json" in json.loads(checked.stdout)["problem"]
