"""A mission's folder is private and leaves with it, also when its owner was killed."""

import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from deploy.config.workdir import PREFIX, mission_folder


@pytest.fixture
def temporary(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A temporary folder of our own; pytest's have paths too long for sockets."""
    with tempfile.TemporaryDirectory() as name:
        monkeypatch.setenv("TMPDIR", name)
        monkeypatch.setattr("tempfile.tempdir", None)
        yield Path(name)


def test_only_the_owner_may_enter(temporary: Path) -> None:
    with mission_folder() as folder:
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert folder.parent == temporary
    assert not folder.exists()


def test_what_a_killed_owner_left_is_swept(temporary: Path) -> None:
    script = (
        "import os, deploy.config.workdir\n"
        "with deploy.config.workdir.mission_folder(): os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", script], env=os.environ, check=False)
    left = list(temporary.glob(f"{PREFIX}*"))
    assert len(left) == 1
    with mission_folder() as folder:
        assert list(temporary.glob(f"{PREFIX}*")) == [folder]


def test_the_folder_of_a_living_mission_is_left_alone(temporary: Path) -> None:
    with mission_folder() as first, mission_folder() as second:
        assert first.exists()
        assert second.exists()
    assert not list(temporary.iterdir())


def test_a_path_too_long_for_sockets_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = tmp_path / ("x" * 90)
    deep.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(deep))
    with pytest.raises(ValueError, match="TMPDIR"), mission_folder():
        pass
    assert not list(deep.iterdir())
