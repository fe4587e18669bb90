"""Who can write neither beside our sources nor at home has a private folder for compiled code."""

import os
import tempfile
from pathlib import Path

import pytest

from services.system.numba_cache import provide_numba_cache

NOWHERE = Path("/proc/1/nowhere")
"""A folder that nobody can make, not even root."""


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def named(environment: dict[str, str], beside: Path = NOWHERE) -> str | None:
    provide_numba_cache(environment, beside)
    return environment.get("NUMBA_CACHE_DIR")


def test_who_can_write_somewhere_keeps_it(temporary: Path) -> None:
    assert named({"HOME": str(temporary)}) is None
    assert named({"HOME": str(NOWHERE), "XDG_CACHE_HOME": str(temporary)}) is None
    assert named({"HOME": str(NOWHERE)}, temporary / "__pycache__") is None
    assert named({"HOME": str(NOWHERE), "NUMBA_CACHE_DIR": "/of/the/user"}) == "/of/the/user"


def test_who_cannot_has_one_folder_for_all_commands_that_nobody_else_may_read(temporary: Path) -> None:
    found = named({"HOME": str(NOWHERE)})
    assert found == str(temporary / f"zenfi-{os.getuid()}") == named({"HOME": str(NOWHERE)})
    assert Path(found).stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("trap", ["open", "link", "file"])
def test_a_folder_that_is_not_ours_alone_is_not_used(temporary: Path, trap: str) -> None:
    waiting = temporary / f"zenfi-{os.getuid()}"
    if trap == "open":
        waiting.mkdir()
        waiting.chmod(0o777)
    elif trap == "link":
        (temporary / "elsewhere").mkdir(mode=0o700)
        waiting.symlink_to(temporary / "elsewhere")
    else:
        waiting.touch()
    found = named({"HOME": str(NOWHERE)})
    assert found is not None
    assert Path(found) != waiting
    assert Path(found).parent == temporary
    assert Path(found).stat().st_mode & 0o777 == 0o700
