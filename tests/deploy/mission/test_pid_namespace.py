"""Nodes that have the same pids in every flight: what they know of them, how they die, what they leave."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from deploy.config.processes import STACK
from deploy.errors import InfrastructureError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from services.models.mission import MissionSpec
from tests.conftest import forked
from tests.fixtures.nodes.numbered import LEFT

SPEC = MissionSpec(world="sparse", seed=7)


@contextmanager
def server_with(control: str) -> Iterator[ForkServer]:
    if subprocess.run([sys.executable, "-m", "injector.reproducible.pid_namespace"], check=False).returncode:
        pytest.skip("no pid namespaces here")
    module = f"tests.fixtures.nodes.{control}"
    server = ForkServer({**STACK, "control": replace(STACK["control"], module=module)})
    try:
        assert server.fixed_pids
        yield server
    finally:
        server.close()


def numbers(server: ForkServer) -> str:
    with pytest.raises(InfrastructureError, match="numbers") as failure:
        fly(SPEC, server)
    return str(failure.value).partition("numbers ")[2]


def names() -> set[str]:
    """What the processes of this machine call themselves."""
    found = set()
    for entry in Path("/proc").iterdir():
        try:
            found.add((entry / "comm").read_text().strip())
        except OSError:
            continue
    return found


def test_a_node_has_the_same_pid_and_tid_in_every_flight() -> None:
    with server_with("numbered") as server:
        first = numbers(server)
        assert len(set(first.split())) == 1  # pid, tid, and what a mutex that it locks has of it
        assert int(first.split()[0]) != os.getpid()
        assert numbers(server) == first
        assert LEFT not in names()
        assert not forked(server.pid)


def test_a_node_that_aborts_is_told_to_have_aborted() -> None:
    with server_with("aborts") as server:
        outcome = fly(SPEC, server).outcome
        assert outcome.nodes["control"].causes == ["SIGABRT"]
        assert outcome.nodes["control"].restarts == 1
        assert outcome.result == "success"
        assert outcome.fixed_pids
