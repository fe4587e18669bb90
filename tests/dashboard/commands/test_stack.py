"""``zenfi up`` and its kin as people and programs meet them."""

import contextlib
import json
import os
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from deploy.compose.control import ControlRequest, NotUpError, ask
from deploy.compose.system.process_tree import clear_marked
from tests.conftest import PATIENCE_S, alive, wait_until
from tests.dashboard.command import ZENFI, refusal, zenfi

STACK = """
name = "trial"
logs = "logs"

[processes.greeter]
command = ["sh", "-c", "echo hello; exec sleep 1000"]

[processes.once]
command = ["true"]
needs = ["greeter"]
ready = { exits = true }
"""
BROKEN = """
[processes.broken]
command = ["false"]
restart = "never"
ready = { exits = true }
"""


@pytest.fixture
def file(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    # pytest's folders have paths too long for sockets.
    with tempfile.TemporaryDirectory() as name:
        monkeypatch.setenv("XDG_RUNTIME_DIR", name)
        path = Path(name) / "stack.toml"
        path.write_text(STACK)
        yield path
        folder = Path(name) / "zenfi" / "trial"
        if folder.exists():
            with contextlib.suppress(NotUpError):
                os.kill(ask(folder, ControlRequest(do="tell")).pid, signal.SIGKILL)
            clear_marked(folder)


def up_and_away(file: Path) -> subprocess.CompletedProcess[str]:
    """The stack in the background; the command that started it has ended."""
    command = [ZENFI, "up", "-d", "--file", str(file), "--json"]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


def phases(told: str) -> dict[str, str]:
    return {one["name"]: one["phase"] for one in json.loads(told)["processes"]}


def test_a_stack_from_up_to_down(file: Path) -> None:
    up = up_and_away(file)
    assert (up.returncode, up.stderr) == (0, "")
    assert phases(up.stdout) == {"greeter": "ready", "once": "exited"}
    supervisor = json.loads(up.stdout)["pid"]

    stopped = zenfi("stop", "greeter", "--json")
    assert (stopped.returncode, phases(stopped.stdout)["greeter"]) == (0, "stopped")

    file.write_text(STACK + BROKEN)
    changed = up_and_away(file)
    assert changed.returncode == 1
    assert "broken is failed: exit status 1" in changed.stderr
    assert phases(changed.stdout) == {"greeter": "ready", "once": "exited", "broken": "failed"}
    assert json.loads(changed.stdout)["pid"] == supervisor

    table = zenfi("ps").stdout
    assert "greeter" in table
    assert "exit status 1" in table

    assert zenfi("down").returncode == 0
    assert not alive(supervisor)


def test_in_the_foreground_it_lives_until_ctrl_c(file: Path) -> None:
    with subprocess.Popen([ZENFI, "up", "--file", str(file)], stdout=subprocess.PIPE, text=True) as front:
        assert front.stdout is not None
        assert any("hello" in line for line in front.stdout)
        view = json.loads(zenfi("ps", "--stack", "trial", "--json").stdout)
        followed = subprocess.Popen([ZENFI, "logs", "-f", "greeter"], stdout=subprocess.PIPE, text=True)
        assert followed.stdout is not None
        assert followed.stdout.readline().split()[1:] == ["hello"]
        zenfi("restart", "greeter")
        assert followed.stdout.readline().split()[1:] == ["hello"]
        followed.send_signal(signal.SIGINT)
        assert followed.wait(PATIENCE_S) == 130
        followed.stdout.close()
        front.send_signal(signal.SIGINT)
        assert front.wait(PATIENCE_S) == 130
    assert not alive(view["pid"])


def test_killed_with_kill_9_the_foreground_leaves_nothing(file: Path) -> None:
    with subprocess.Popen([ZENFI, "up", "--file", str(file)], stdout=subprocess.PIPE, text=True) as front:
        assert front.stdout is not None
        assert any("hello" in line for line in front.stdout)
        view = json.loads(zenfi("ps", "--json").stdout)
        front.kill()
    pids = [view["pid"], *(one["pid"] for one in view["processes"] if one["pid"])]
    wait_until(lambda: not any(alive(pid) for pid in pids), PATIENCE_S)


def test_down_clears_what_a_killed_supervisor_left(file: Path) -> None:
    view = json.loads(up_and_away(file).stdout)
    os.kill(view["pid"], signal.SIGKILL)
    wait_until(lambda: not alive(view["pid"]), PATIENCE_S)
    down = zenfi("down", "--stack", "trial")
    assert (down.returncode, "was not up" in down.stderr) == (0, True)
    assert not any(alive(one["pid"]) for one in view["processes"] if one["pid"])


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["up", "-d", "--file", "nowhere.toml"], "nowhere.toml: No such file or directory"),
        (["ps", "--stack", "../x"], "'../x' is no stack's name"),
        (["logs"], "stack laboratory is not up: zenfi up"),
        (["down", "--stack", "none"], "stack none is not up"),
    ],
)
def test_nonsense_is_refused_in_one_line(file: Path, arguments: list[str], told: str) -> None:  # noqa: ARG001
    assert told in refusal(*arguments)


def test_certificates_are_made_once(tmp_path: Path) -> None:
    made = zenfi("certificates", tmp_path / "lab", "lab-1=10.0.0.1", "lab-2", "--viewer", "laptop")
    assert made.stdout.split() == [str(tmp_path / "lab" / name) for name in ("lab-1", "lab-2", "laptop")]
    assert "lab-1 is there already" in refusal("certificates", tmp_path / "lab", "lab-1")
    assert "for whom?" in refusal("certificates", tmp_path / "lab")
