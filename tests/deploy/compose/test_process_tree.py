"""What a killed supervisor has left is cleared, also while its reapers clear up."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.compose import process_tree
from deploy.compose.process_tree import MARK, clear_marked
from tests.conftest import wait_until


def marked(folder: Path) -> subprocess.Popen[bytes]:
    """A process of the stack in ``folder``; its environment can be read, which takes a moment after exec."""
    process = subprocess.Popen(
        [sys.executable, "-c", "import time; time.sleep(1000)"], env={**os.environ, MARK: str(folder)}
    )
    wait_until(lambda: MARK.encode() in Path(f"/proc/{process.pid}/environ").read_bytes())
    return process


def test_what_is_marked_is_killed_and_nothing_else(tmp_path: Path) -> None:
    ours, another = marked(tmp_path), marked(tmp_path / "another")
    try:
        assert clear_marked(tmp_path) == 1
        assert ours.wait() == -9
        assert another.poll() is None
    finally:
        another.kill()
        another.wait()


def test_what_is_gone_before_it_is_killed_is_not_missed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reaper kills and reaps its process at the instant between our look and our signal."""
    left = marked(tmp_path)
    looks: list[int] = []

    def then_gone(pid: int, mark: bytes) -> bool:
        found = is_marked(pid, mark)
        if found:
            looks.append(pid)
        if len(looks) == 2:  # found, and looked at again with its pidfd in hand
            left.kill()
            left.wait()
        return found

    is_marked = process_tree._marked
    monkeypatch.setattr(process_tree, "_marked", then_gone)
    assert clear_marked(tmp_path) == 0
    assert looks == [left.pid, left.pid]
