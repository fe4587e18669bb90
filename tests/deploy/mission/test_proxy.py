"""A node and its proxy live and die together, and nothing that a dying node said is lost."""

import os
import signal
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from deploy.config.processes import STACK
from deploy.errors import InfrastructureError
from deploy.mission.flight import fly
from deploy.mission.fork_protocol import SIDE_SERVER
from deploy.mission.fork_server import ForkServer, ForkServerError
from services.models.faults.specification import FaultSpec, Trigger
from services.models.mission import MissionSpec
from tests.conftest import alive, descendants, forked, node, wait_until
from tests.deploy.mid_flight import fly_and
from tests.deploy.mission.test_flight import assert_nothing_is_left, load

SPEC = MissionSpec(world="sparse", seed=7)


def proxies(pid: int) -> list[int]:
    return [one for one, name in descendants(pid).items() if name.startswith("proxy-")]


def test_each_node_has_one_thread_and_a_proxy_for_its_parent(server: ForkServer) -> None:
    seen: list[tuple[int, int]] = []

    def look() -> None:
        for name in ("sim", "perception", "planning", "control"):
            pid = node(os.getpid(), name)
            assert pid is not None
            threads = len(list(Path(f"/proc/{pid}/task").iterdir()))
            parent = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
            seen.append((threads, parent))

    def watched() -> None:
        look()
        seen.extend((0, one) for one in proxies(os.getpid()))

    fly_and(server, SPEC, watched)
    nodes, proxy_pids = seen[:4], {pid for _, pid in seen[4:]}
    assert {threads for threads, _ in nodes} == {1}
    assert {parent for _, parent in nodes} == proxy_pids
    assert len(proxy_pids) == 4


def test_a_proxy_that_dies_is_our_failure(server: ForkServer) -> None:
    with pytest.raises(InfrastructureError, match="proxy"):
        fly_and(server, SPEC, lambda: os.kill(proxies(os.getpid())[0], signal.SIGKILL))
    wait_until(lambda: not forked(server.pid))
    assert fly(SPEC, server).outcome.result == "success"
    assert_nothing_is_left(server)


@pytest.mark.parametrize("side", [False, True])
def test_a_server_is_lost_with_either_of_its_processes(side: bool) -> None:
    struck = SPEC.model_copy(update={"fault": FaultSpec(target="pid", trigger=Trigger(invocation=3))})
    with closing(ForkServer()) as server:
        assert not server.is_lost()
        beside = next(pid for pid, name in descendants(server.pid).items() if name == SIDE_SERVER)
        os.kill(beside if side else server.pid, signal.SIGKILL)
        wait_until(server.is_lost)
        with pytest.raises(ForkServerError, match="gone"):
            fly(struck, server)


_FLIER = """
from deploy.mission.fork_server import ForkServer
from tests.deploy.mid_flight import fly_and
from tests.deploy.mission.test_proxy import SPEC
while True:
    fly_and(ForkServer(), SPEC, lambda: print("in mid flight", flush=True))
"""


@pytest.mark.parametrize("victim", ["supervisor", "fork server"])
def test_nobody_outlives_a_killed_parent(victim: str) -> None:
    flier = [sys.executable, "-c", _FLIER]
    here = Path(__file__).parents[3]
    with subprocess.Popen(flier, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=here) as supervisor:
        try:
            assert supervisor.stdout is not None
            assert supervisor.stdout.readline() == b"in mid flight\n"
            family = descendants(supervisor.pid)
            server = next(pid for pid, name in family.items() if "-" not in name)
            os.kill(supervisor.pid if victim == "supervisor" else server, signal.SIGKILL)
            wait_until(lambda: not any(alive(pid) for pid in family))
        finally:
            supervisor.kill()


def memory_of_control(server: ForkServer) -> str:
    with pytest.raises(InfrastructureError, match="memory") as failure:
        fly(SPEC, server)
    return str(failure.value)


@pytest.mark.soak
def test_the_memory_of_a_node_is_that_of_every_flight() -> None:
    """Whatever was flown before, on a loaded machine, on another fork server."""
    stack = {**STACK, "control": replace(STACK["control"], module="tests.fixtures.nodes.surveyed")}
    # The first server may have something to compile, which is then where it will not be again.
    ForkServer(stack).close()
    server, other = ForkServer(stack), ForkServer(stack)
    try:
        first = memory_of_control(server)
        assert memory_of_control(server) == first
        with load(2):
            assert memory_of_control(server) == first
        assert memory_of_control(other) == first
    finally:
        server.close()
        other.close()
