"""Nodes that misbehave in ways of their own: what the supervisor makes of them."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from deploy.config.processes import STACK
from deploy.errors import InfrastructureError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from injector.tracing import ptrace
from services.models.mission import Limits, MissionSpec
from services.system.process_stat import process_stat
from tests.conftest import forked, node, wait_until
from tests.deploy.mid_flight import fly_and

SPEC = MissionSpec(seed=7, limits=Limits(hang_cpu_s=1.0))


@contextmanager
def control_replaced_by(fixture: str) -> Iterator[ForkServer]:
    module = f"tests.fixtures.nodes.{fixture}"
    server = ForkServer({**STACK, "control": replace(STACK["control"], module=module)})
    try:
        yield server
    finally:
        server.close()


@pytest.mark.soak
def test_a_hang_is_a_result_and_the_flight_repeats() -> None:
    with control_replaced_by("hangs") as server:
        first, second = fly(SPEC, server).outcome, fly(SPEC, server).outcome
    assert first.nodes["control"].result == "hang"
    assert first.nodes["control"].restarts == 1
    assert first.result == "success"
    assert first.digest == second.digest


@pytest.mark.soak
def test_what_a_node_uses_while_it_is_traced_is_no_hang() -> None:
    """An injector that counts passes stops it a hundred thousand times."""
    traced_s = []

    def trace() -> None:
        control = node(os.getpid(), "control")
        assert control is not None
        begin_s = process_stat(control).cpu_s

        def used_s() -> float:
            return process_stat(control).cpu_s - begin_s

        ptrace.seize(control)
        wait_until(lambda: used_s() > 1.5 * SPEC.limits.hang_cpu_s or process_stat(control).state == "Z")
        traced_s.append(used_s())
        ptrace.interrupt(control)
        ptrace.await_report(control)
        ptrace.detach(control)

    with control_replaced_by("hangs") as server:
        flown = fly_and(server, SPEC, trace).outcome
    assert traced_s[0] > 1.4 * SPEC.limits.hang_cpu_s
    assert flown.nodes["control"].causes == ["hang"]  # later


def test_a_crash_at_the_same_place_gives_the_same_flight() -> None:
    short = SPEC.model_copy(update={"limits": Limits(mission_time_s=8.0)})
    with control_replaced_by("crashes") as server:
        first, second = fly(short, server).outcome, fly(short, server).outcome
    assert first.nodes["control"].result == "crash"
    assert first.nodes["control"].causes == ["SIGSEGV"]
    assert first.digest == second.digest
    assert first.qof == second.qof


def test_a_bug_of_ours_is_no_result() -> None:
    with control_replaced_by("raises") as server:
        with pytest.raises(InfrastructureError, match="wings fell off"):
            fly(SPEC, server)
        assert not forked(server.pid)
