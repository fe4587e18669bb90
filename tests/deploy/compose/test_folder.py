"""A stack's folder is its supervisor's alone."""

import concurrent.futures
import contextlib
import stat
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from deploy.compose.control import ControlRequest, ask
from deploy.compose.folder import TakenError, UnsafeFolderError, held, stack_folder
from tests.conftest import PATIENCE_S


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        monkeypatch.setenv("XDG_RUNTIME_DIR", name)
        yield stack_folder("x")


def test_only_the_owner_may_enter_and_nothing_stays(folder: Path) -> None:
    with held(folder):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert stat.S_IMODE(folder.parent.stat().st_mode) == 0o700
    assert not folder.exists()


@pytest.mark.soak
def test_there_is_one_holder(folder: Path) -> None:
    with held(folder):
        with pytest.raises(TakenError, match="stack x is up already"), held(folder):
            pass
        assert folder.exists()
    with held(folder):
        pass


def test_it_waits_for_a_holder_that_is_dying(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deploy.compose.folder.DYING_S", PATIENCE_S)
    with contextlib.ExitStack() as leaving:
        leaving.enter_context(held(folder))
        threading.Timer(0.2, leaving.pop_all().close).start()
        with held(folder):
            assert (folder / "lock").exists()
    assert not folder.exists()


def test_what_a_dead_holder_left_is_removed(folder: Path) -> None:
    folder.mkdir(mode=0o700, parents=True)
    folder.parent.chmod(0o700)
    (folder / "control.sock").touch()
    with held(folder):
        assert [entry.name for entry in folder.iterdir()] == ["lock"]


def test_a_folder_that_others_can_enter_is_refused(folder: Path) -> None:
    folder.parent.mkdir(mode=0o700)
    folder.parent.chmod(0o755)
    with pytest.raises(UnsafeFolderError, match="yours alone"), held(folder):
        pass
    with pytest.raises(UnsafeFolderError, match="yours alone"):
        ask(folder, ControlRequest(do="tell"))


def test_a_link_is_refused(folder: Path, tmp_path: Path) -> None:
    folder.parent.symlink_to(tmp_path)
    with pytest.raises(UnsafeFolderError, match="yours alone"), held(folder):
        pass


def test_a_path_too_long_for_sockets_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    deep = tmp_path / ("x" * 90)
    deep.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(deep))
    with pytest.raises(UnsafeFolderError, match="XDG_RUNTIME_DIR"), held(stack_folder("x")):
        pass
    assert not list(deep.iterdir())


def test_holders_that_come_and_go_at_once_never_meet_and_never_fail(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who comes may find the folder gone between any two looks at it."""
    monkeypatch.setattr("deploy.compose.folder.DYING_S", PATIENCE_S)
    inside: list[int] = []

    def come_and_go(number: int) -> None:
        for _ in range(60):
            with held(folder):
                inside.append(number)
                assert inside == [number]
                inside.remove(number)

    with concurrent.futures.ThreadPoolExecutor(4) as threads:
        list(threads.map(come_and_go, range(4)))
    assert not folder.exists()
