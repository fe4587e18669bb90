"""What a killed supervisor has left is cleared, also while its reapers clear up."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.compose.system.process_tree import MARK, clear_marked
from tests.conftest import alive, wait_until


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
        assert clear_marked(tmp_path) == (1, 0)
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

    def too_late(pidfd: int, number: int) -> None:
        left.kill()
        left.wait()
        send(pidfd, number)

    send = signal.pidfd_send_signal
    monkeypatch.setattr(signal, "pidfd_send_signal", too_late)
    assert clear_marked(tmp_path) == (0, 0)


def test_who_is_ending_already_is_waited_for(tmp_path: Path) -> None:
    """It has no environment any more, so no mark; its parent has, as a reaper has."""
    large = "import time; memory = bytearray(300 << 20); print(flush=True); time.sleep(1000)"  # slow to free
    with subprocess.Popen(
        ["/bin/sh", "-c", '"$0" -c "$1" & echo $!; wait', sys.executable, large],
        env={**os.environ, MARK: str(tmp_path)},
        stdout=subprocess.PIPE,
        text=True,
    ) as reaper:
        assert reaper.stdout is not None
        ending = int(reaper.stdout.readline())
        assert reaper.stdout.readline() == "\n"
        os.kill(ending, signal.SIGKILL)
        wait_until(lambda: not has_environment(ending))
        clear_marked(tmp_path)
        assert not alive(ending)


def has_environment(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/environ").read_bytes() != b""
    except ProcessLookupError:
        return False


def test_a_child_without_the_mark_ends_with_its_family(tmp_path: Path) -> None:
    command = ["/bin/sh", "-c", f"env -u {MARK} sleep 1000 & echo $!; wait"]
    with subprocess.Popen(
        command, env={**os.environ, MARK: str(tmp_path)}, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        wait_until(lambda: MARK.encode() not in Path(f"/proc/{child}/environ").read_bytes())
        assert clear_marked(tmp_path) == (2, 0)
        assert not alive(child)


def test_what_another_user_owns_is_left_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, other = marked(tmp_path), marked(tmp_path)

    def refuses(pidfd: int, number: int) -> None:
        held = Path(f"/proc/self/fdinfo/{pidfd}").read_text().split("Pid:")[1].split()[0]
        if int(held) == other.pid:
            raise PermissionError
        send(pidfd, number)

    send = signal.pidfd_send_signal
    monkeypatch.setattr(signal, "pidfd_send_signal", refuses)
    try:
        assert clear_marked(tmp_path) == (1, 1)
        assert (ours.wait(), other.poll()) == (-9, None)
    finally:
        other.kill()
        other.wait()
