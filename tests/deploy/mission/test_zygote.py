"""The fork server's own process."""

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from importlib.util import cache_from_source
from pathlib import Path

import pytest

from deploy.config.processes import STACK, ProcessDeclaration
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from services.models.mission import Limits, MissionSpec
from services.runtime import latency
from tests.process_memory import different, memory


@pytest.mark.soak
def test_two_servers_never_compile_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their randomness is the same, and so are the names of the files that numba writes first."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    stack = {"slow": ProcessDeclaration("slow", "tests.fixtures.nodes.warms")}
    with ThreadPoolExecutor() as pool:
        for server in pool.map(lambda _: ForkServer(stack), range(3)):
            server.close()
    noted = [line.split(maxsplit=1) for line in (tmp_path / "warming").read_text().splitlines()]
    assert len({pid for pid, _ in noted}) == 3
    for (pid, begins), (same, is_done) in zip(noted[::2], noted[1::2], strict=True):
        assert (pid, begins, is_done) == (same, "begins", "is done")


@pytest.mark.soak
def test_a_server_that_had_to_compile_has_the_memory_of_the_others() -> None:
    Path(cache_from_source(latency.__file__)).unlink(missing_ok=True)
    memories = []
    for _ in range(3):
        with closing(ForkServer()) as server:
            memories.append(memory(server.pid))
    compiled, second, third = memories
    # Pids and times are in the same places of any two.
    alike = different(second, third, numbers=False)
    assert len(alike) < 200
    assert len(different(compiled, second, numbers=False) - alike) < 40


@pytest.mark.soak
def test_what_a_server_has_forked_leaves_no_trace_in_its_memory() -> None:
    """What it forks fiftieth begins with the memory of what it forks fifth."""
    spec = MissionSpec(world="sparse", limits=Limits(mission_time_s=0.2))
    with closing(ForkServer()) as server:
        fly(spec, server)
        first = memory(server.pid)
        for _ in range(9):
            fly(spec, server)
        # The pid of what was forked last lies on the stack and in the C library.
        assert len(different(first, memory(server.pid))) < 5


def test_nodes_have_nothing_to_compile_or_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each flight would do it anew, and what it does then lies in a node's memory."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    learns = "tests.fixtures.nodes.learns"
    stack = {name: one if one.sidecar else replace(one, module=learns) for name, one in STACK.items()}
    with closing(ForkServer(stack)) as server:
        assert fly(MissionSpec(world="dense", seed=7), server).outcome.result == "success"
    learnt = (tmp_path / "learnt").read_text().splitlines()
    assert sorted(learnt) == [f"{name} begins" for name in ("control", "perception", "planning", "sim")]
