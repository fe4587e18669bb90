"""Supervisors with real processes, well-behaved and not."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.compose.control import ControlRefusedError, NotUpError
from tests.conftest import PATIENCE_S, alive, descendants, wait_until
from tests.deploy.compose.conftest import PROCESSES, QUICKLY, SLEEP, Laboratory, fixture


def test_processes_start_in_the_order_of_their_needs(laboratory: Laboratory) -> None:
    laboratory.up(
        {
            "top": {"command": SLEEP, "needs": ["once", "base"]},
            "base": {"command": SLEEP},
            "once": {"command": ["true"], "ready": {"exits": True}},
        }
    )
    laboratory.phase("top", "ready")
    story = "\n".join(laboratory.log("supervisor"))
    started = story.index('"event": "starting", "process": "top"')
    assert story.index('"event": "ready", "process": "base"') < started
    assert story.index('"event": "exited", "process": "once"') < started
    laboratory.down()
    story = "\n".join(laboratory.log("supervisor"))
    gone = story.index('"event": "stopped", "process": "top"')
    assert gone < story.index('"event": "stopping", "process": "base"')


def test_who_crashes_at_once_is_given_up_after_the_restarts_that_it_has(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": ["sh", "-c", "echo woe >&2; exit 3"], "restarts": 3}})
    one = laboratory.phase("x", "failed")
    assert (one.life, one.restarts, one.status, one.pid) == (4, 3, 3, None)
    assert "exit status 3" in one.reason
    assert laboratory.log() == ["woe"] * 4


def test_who_is_killed_is_told_by_the_signal(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": ["sh", "-c", "kill -SEGV $$"], "restart": "never"}})
    one = laboratory.phase("x", "failed")
    assert (one.status, one.reason) == (-signal.SIGSEGV, "SIGSEGV")


def test_who_cannot_be_started_has_failed_with_the_reason(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": ["/no/such/program"]}, "y": {"command": SLEEP, "needs": ["x"]}})
    assert laboratory.phase("x", "failed").reason == "/no/such/program: No such file or directory"
    assert laboratory.one("y").phase == "pending"
    assert laboratory.one("y").reason == "needs x"


def test_who_never_gets_ready_is_stopped_and_given_up(laboratory: Laboratory) -> None:
    ready = {"announces": "nobody", "within_s": 0.2}
    laboratory.up({"x": {"command": SLEEP, "ready": ready, "restarts": 1}})
    one = laboratory.phase("x", "failed")
    assert "not ready within 0.2 s" in one.reason
    assert (one.life, one.status) == (2, -signal.SIGTERM)


def test_who_ignores_the_stop_signal_is_killed_when_its_grace_is_over(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": fixture("ignores_sigterm"), "stop": {"grace_s": 0.2}}})
    wait_until(lambda: laboratory.log() == ["deaf"], PATIENCE_S)
    laboratory.ask("stop", "x")
    assert laboratory.phase("x", "stopped").status == -signal.SIGKILL
    assert '{"event": "killed", "process": "x", "life": 1}' in laboratory.log("supervisor")


def test_the_stop_signal_is_the_declared_one(laboratory: Laboratory) -> None:
    script = "trap 'echo interrupted; exit 0' INT; echo set; while :; do sleep 0.01; done"
    laboratory.up({"x": {"command": ["sh", "-c", script], "stop": {"signal": "SIGINT"}}})
    wait_until(lambda: laboratory.log() == ["set"], PATIENCE_S)
    laboratory.ask("stop", "x")
    laboratory.phase("x", "stopped")
    assert laboratory.log() == ["set", "interrupted"]


def test_what_a_flood_loses_is_counted_to_the_line(laboratory: Laboratory) -> None:
    lines = 30_000
    log = {"file_bytes": 10_000_000, "bytes_per_s": 50_000}
    laboratory.up({"x": {"command": fixture("floods", str(lines)), "log": log}})
    one = laboratory.phase("x", "exited")
    kept = [line for line in laboratory.log() if line.startswith("line ")]
    assert one.lost_lines > 0
    assert len(kept) + one.lost_lines == lines
    told = [int(line.split()[1]) for line in laboratory.log() if "lines lost here" in line]
    assert sum(told) == one.lost_lines


def test_a_flood_that_never_ends_disturbs_nobody(laboratory: Laboratory) -> None:
    log = {"file_bytes": 20_000, "files": 3, "bytes_per_s": 50_000}
    laboratory.up({"x": {"command": fixture("floods"), "log": log}, "y": {"command": SLEEP, "needs": ["x"]}})
    laboratory.phase("y", "ready")
    laboratory.until("x", lambda one: one.lost_lines > 10_000)
    laboratory.ask("stop", "x")
    laboratory.phase("x", "stopped")
    files = sorted(laboratory.one("x").log.parent.glob("x.log*"))
    assert [file.name for file in files] == ["x.log", "x.log.1", "x.log.2"]
    assert all(file.stat().st_size <= 20_000 for file in files)


@pytest.mark.parametrize("how", [[], ["leave"]])
def test_nothing_is_left_of_who_forks_and_daemonises(laboratory: Laboratory, how: list[str]) -> None:
    laboratory.up({"x": {"command": fixture("forks", *how), "restart": "never"}})
    if not how:
        one = laboratory.until("x", lambda one: one.processes == 4)
        assert one.memory_bytes > 0
        family = set(descendants(laboratory.started[0].process.pid))
        laboratory.ask("stop", "x")
        one = laboratory.phase("x", "stopped")
        assert not any(alive(pid) for pid in family)
    else:
        one = laboratory.phase("x", "exited")
    assert one.cleared == 3
    assert one.processes == 0
    assert not descendants(laboratory.started[0].process.pid)


def test_after_kill_9_of_the_supervisor_nothing_is_left(laboratory: Laboratory) -> None:
    first = {"x": {"command": fixture("forks")}, "y": {"command": fixture("ignores_sigterm")}}
    laboratory.up(first)
    laboratory.until("x", lambda one: one.processes == 4)
    laboratory.until("y", lambda one: one.processes == 1)

    def all_there() -> bool:
        """Two reapers, x with three others, y; the one in the middle has made x's daemon, and is gone."""
        names = descendants(laboratory.started[0].process.pid).values()
        return len(names) == 7 and "sleep" in names

    wait_until(all_there, PATIENCE_S)
    family = set(descendants(laboratory.started[0].process.pid))
    laboratory.started[0].process.kill()
    laboratory.started[0].process.wait()
    view = laboratory.up(first)
    assert not any(alive(pid) for pid in family)
    assert view.pid != laboratory.started[0].process.pid
    laboratory.until("x", lambda one: one.processes == 4)


def test_what_outlives_supervisor_and_reaper_is_cleared_by_the_next_start(laboratory: Laboratory) -> None:
    orphan = "import os, time\nif os.fork() == 0: os.setsid()\ntime.sleep(1000)"
    laboratory.up({"x": {"command": [sys.executable, "-c", orphan]}})
    laboratory.until("x", lambda one: one.processes == 2)
    supervisor = laboratory.started[0].process
    reaper = next(pid for pid, name in descendants(supervisor.pid).items() if name == "zenfi-reaper")
    leader = laboratory.one("x").pid
    left = [pid for pid in descendants(reaper) if pid != leader]
    # Stopped, neither can do anything about the other's death.
    for pid in (reaper, supervisor.pid):
        os.kill(pid, signal.SIGSTOP)
    for pid in (supervisor.pid, reaper):
        os.kill(pid, signal.SIGKILL)
    supervisor.wait()
    wait_until(lambda: not alive(leader or 0), PATIENCE_S)
    assert [alive(pid) for pid in left] == [True]
    view = laboratory.up({"y": {"command": SLEEP}})
    assert not alive(left[0])
    assert view.cleared == 1


def test_who_loses_its_reaper_is_cleared_and_started_again(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": fixture("forks")}})
    laboratory.until("x", lambda one: one.processes == 4)
    family = descendants(laboratory.started[0].process.pid)
    os.kill(next(pid for pid, name in family.items() if name == "zenfi-reaper"), signal.SIGKILL)
    one = laboratory.until("x", lambda one: one.life == 2 and one.processes == 4)
    assert not any(alive(pid) for pid in family)
    assert one.restarts == 1
    assert laboratory.ask("tell").strays >= 3


def test_an_attached_supervisor_goes_down_with_whoever_started_it(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": SLEEP}}, attached=True)
    pid = laboratory.phase("x", "ready").pid
    stdin = laboratory.started[0].process.stdin
    assert stdin is not None
    stdin.close()
    assert laboratory.started[0].process.wait(PATIENCE_S) == 0
    assert not alive(pid or 0)


def test_signals_are_counted_and_the_second_kills(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": fixture("ignores_sigterm"), "stop": {"grace_s": 1000}}})
    wait_until(lambda: laboratory.log() == ["deaf"], PATIENCE_S)
    supervisor = laboratory.started[0].process
    supervisor.send_signal(signal.SIGTERM)
    laboratory.phase("x", "stopping")
    view = laboratory.ask("tell")
    assert view.signals == {"SIGTERM": 1}
    assert view.leaving
    supervisor.send_signal(signal.SIGINT)
    assert supervisor.wait(PATIENCE_S) == 0
    assert '{"event": "down", "signals": {"SIGTERM": 1, "SIGINT": 1}}' in laboratory.log("supervisor")
    with pytest.raises(NotUpError):
        laboratory.ask("tell")
    assert not (laboratory.folder / "zenfi" / "test").exists()


def test_restart_stop_and_start(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": SLEEP}, "y": {"command": SLEEP, "needs": ["x"]}})
    first = laboratory.phase("x", "ready")
    other = laboratory.phase("y", "ready").pid
    laboratory.ask("restart", "x")
    again = laboratory.until("x", lambda one: one.phase == "ready" and one.life == 2)
    assert again.pid != first.pid
    assert again.restarts == 0
    assert laboratory.one("y").pid == other
    laboratory.ask("stop", "x")
    laboratory.phase("x", "stopped")
    laboratory.ask("start", "y")
    laboratory.phase("x", "ready")


def test_declared_anew_only_what_has_changed_starts_anew(laboratory: Laboratory) -> None:
    laboratory.up({"same": {"command": SLEEP}, "other": {"command": SLEEP}, "gone": {"command": SLEEP}})
    pids = {name: laboratory.phase(name, "ready").pid for name in ("same", "other", "gone")}
    changed = {"command": SLEEP, "environment": {"A": "1"}}
    laboratory.ask("declare", stack=laboratory.stack({"same": {"command": SLEEP}, "other": changed}))
    wait_until(
        lambda: [one.name for one in laboratory.ask("tell").processes] == ["same", "other"], PATIENCE_S
    )
    laboratory.until("other", lambda one: one.phase == "ready" and one.life == 2)
    assert laboratory.one("same").pid == pids["same"]
    assert not alive(pids["gone"] or 0)


def test_a_process_finds_its_environment_and_folder(laboratory: Laboratory, tmp_path: Path) -> None:
    command = ["sh", "-c", "pwd; echo $GREETING; command -v python; trap - PIPE; kill -PIPE $$"]
    fields = {
        "command": command,
        "environment": {"GREETING": "ho"},
        "folder": str(tmp_path),
        "restart": "never",
    }
    laboratory.up({"x": fields})
    assert laboratory.phase("x", "failed").reason == "SIGPIPE"
    assert laboratory.log() == [str(tmp_path), "ho", str(Path(sys.executable).parent / "python")]


def test_what_is_unknown_is_refused(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": SLEEP}})
    with pytest.raises(ControlRefusedError, match="no process 'z' in stack test; there are: x"):
        laboratory.ask("stop", "z")
    with pytest.raises(ControlRefusedError, match="zenfi down"):
        laboratory.ask("declare", stack=laboratory.stack({"x": {"command": SLEEP}}, logs="/elsewhere"))


@pytest.mark.soak
def test_a_second_supervisor_of_a_stack_is_refused(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": SLEEP}})
    order = f'{{"stack": {laboratory.stack({"x": {"command": SLEEP}}).model_dump_json()}, '
    order += f'"folder": "{laboratory.ask("tell").folder}", "attached": false}}\n'
    second = subprocess.run(
        [sys.executable, "-m", "deploy.compose.daemon"],
        input=order,
        capture_output=True,
        text=True,
        check=False,
    )
    assert second.returncode == 2
    assert second.stderr == "stack test is up already\n"
    assert laboratory.phase("x", "ready").life == 1


def test_nonsense_on_the_control_socket_is_answered_and_survived(laboratory: Laboratory) -> None:
    view = laboratory.up({"x": {"command": SLEEP}})
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(view.folder / "control.sock"))
        connection.sendall(b'{"do": "explode"}\n\xff\xff\n')
        answers = connection.makefile("rb")
        assert b"not a request" in answers.readline()
        assert b"not a request" in answers.readline()
    assert laboratory.phase("x", "ready")


def test_readiness_by_announcement_first_message_and_http(laboratory: Laboratory) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    go = laboratory.folder / "go"
    laboratory.up(
        {
            "node": {
                "command": fixture("announces", "me", "here/x"),
                "folder": str(PROCESSES.parents[2]),
                "environment": {"PYTHONPATH": str(PROCESSES.parents[2])},
                "ready": {"announces": "me", "publishes": "here/**", "within_s": 100},
            },
            "liar": {
                "command": fixture("announces", "you", "there/x", "lie"),
                "environment": {"PYTHONPATH": str(PROCESSES.parents[2])},
                "ready": {"announces": "you", "within_s": 100},
                "needs": ["node"],
            },
            "web": {
                "command": fixture("serves", str(port), str(go)),
                "ready": {"http": f"http://127.0.0.1:{port}/ready", "within_s": 100},
                "needs": ["node"],
            },
            "other": {
                "command": SLEEP,
                "needs": ["node"],
                "ready": {"publishes": "there/x", "within_s": 100},
            },
        }
    )
    laboratory.phase("node", "ready")
    # Any process's message counts, for a key says nothing of its publisher; so the liar has announced itself.
    laboratory.phase("other", "ready")
    wait_until(lambda: "503" in "".join(laboratory.log("web")), PATIENCE_S)
    assert laboratory.one("web").phase == "starting"
    go.touch()
    laboratory.phase("web", "ready")
    assert laboratory.one("liar").phase == "starting"


def test_backing_off_is_shown(laboratory: Laboratory) -> None:
    laboratory.up({"x": {"command": ["false"], "backoff": {**QUICKLY, "first_s": 1000, "most_s": 1000}}})
    one = laboratory.phase("x", "backing_off")
    assert (one.pid, one.reason) == (None, "exit status 1")
    laboratory.down()
