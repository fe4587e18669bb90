"""Processes that hang or fall silent, and what becomes of those that need them."""

import os
import signal
import socket
from typing import Any

import pytest

from tests.conftest import PATIENCE_S
from tests.deploy.compose.conftest import PROCESSES, SLEEP, Laboratory, fixture

ROOT = PROCESSES.parents[2]


@pytest.fixture
def port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def web(laboratory: Laboratory, port: int) -> dict[str, Any]:
    """A server that is probed every tenth of a second."""
    go = laboratory.folder / "go"
    go.touch()
    url = f"http://127.0.0.1:{port}/ready"
    return {
        "command": fixture("serves", str(port), str(go)),
        "ready": {"http": url, "within_s": 100},
        "alive": {"http": url, "every_s": 0.1, "timeout_s": 1, "failures": 2},
        "stop": {"grace_s": 0.2},
        "restarts": 1000,
    }


def test_who_hangs_is_started_again_and_those_that_restart_with_it_before_and_after(
    laboratory: Laboratory, port: int
) -> None:
    laboratory.up(
        {
            "front": {"command": SLEEP, "needs": ["top"], "restarts_with": ["top"]},
            "top": {"command": SLEEP, "needs": ["web"], "restarts_with": ["web"]},
            "other": {"command": SLEEP, "needs": ["web"]},
            "web": web(laboratory, port),
        }
    )
    for name in ("front", "other"):
        laboratory.phase(name, "ready")
    hangs = laboratory.phase("web", "ready")
    os.kill(hangs.pid or 0, signal.SIGSTOP)
    laboratory.until("front", lambda one: one.life >= 2 and one.phase == "ready")
    story = laboratory.log("supervisor")

    def line(event: str, process: str) -> int:
        return next(i for i, one in enumerate(story) if f'"event": "{event}", "process": "{process}"' in one)

    def start_again(process: str) -> int:
        return next(
            i for i, one in enumerate(story) if f'"starting", "process": "{process}", "life": 2' in one
        )

    in_order = [line("stopping", name) for name in ("front", "top", "web")]
    in_order += [start_again(name) for name in ("web", "top", "front")]
    assert in_order == sorted(in_order)
    assert "2 probes in a row failed" in story[line("stopping", "web")]
    assert '"reason": "restarts with web"' in story[line("stopping", "top")]
    assert laboratory.one("other").life == 1
    laboratory.down()


def test_who_falls_silent_on_the_bus_is_not_alive(laboratory: Laboratory) -> None:
    alive = {"announces": "me", "publishes": "here/**", "every_s": 1, "failures": 2}
    laboratory.up(
        {
            "x": {
                "command": fixture("announces", "me", "here/x"),
                "environment": {"PYTHONPATH": str(ROOT)},
                "ready": {"announces": "me", "within_s": 100},
                "alive": alive,
                "stop": {"grace_s": 0.2},
                "restarts": 0,
            },
        }
    )
    os.kill(laboratory.phase("x", "ready").pid or 0, signal.SIGSTOP)
    assert "2 probes in a row failed: no message on here/**" in laboratory.phase("x", "failed").reason


def test_failed_probes_are_shown_before_anything_follows(laboratory: Laboratory, port: int) -> None:
    alive = {"http": f"http://127.0.0.1:{port}/", "every_s": 0.05, "failures": 1000}
    laboratory.up({"x": {"command": SLEEP, "alive": alive}})
    one = laboratory.until("x", lambda one: one.failed_probes > 1)
    assert one.phase == "ready"


def test_a_probe_without_an_answer_keeps_nobody_from_going_down(laboratory: Laboratory, port: int) -> None:
    with socket.create_server(("127.0.0.1", port)) as deaf:
        alive = {"http": f"http://127.0.0.1:{port}/", "every_s": 0.05, "timeout_s": 10_000}
        laboratory.up({"x": {"command": SLEEP, "alive": alive}})
        deaf.settimeout(PATIENCE_S)
        probe, _ = deaf.accept()
        with probe:
            assert probe.recv(1024).startswith(b"GET / HTTP/1.1\r\nHost: 127.0.0.1")
            laboratory.down()
