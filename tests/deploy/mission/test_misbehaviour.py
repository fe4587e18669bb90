"""Nodes that misbehave in ways of their own: what the supervisor makes of them."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from deploy.config.processes import STACK
from deploy.errors import InfrastructureError
from deploy.mission import silence
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from injector.tracing import ptrace
from services.models.faults.specification import FaultSpec, Trigger
from services.models.mission import Limits, MissionSpec
from services.system.process_stat import process_stat
from tests.conftest import forked, node, wait_until
from tests.deploy.mid_flight import fly_and

SPEC = MissionSpec(seed=7, limits=Limits(hang_cpu_s=1.0))


@contextmanager
def replaced(stage: str, by: str) -> Iterator[ForkServer]:
    module = f"tests.fixtures.nodes.{by}"
    server = ForkServer({**STACK, stage: replace(STACK[stage], module=module)})
    try:
        yield server
    finally:
        server.close()


@pytest.mark.soak
def test_a_hang_is_a_result_and_the_flight_repeats() -> None:
    with replaced("control", by="hangs") as server:
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

    with replaced("control", by="hangs") as server:
        flown = fly_and(server, SPEC, trace).outcome
    assert traced_s[0] > 1.4 * SPEC.limits.hang_cpu_s
    assert flown.nodes["control"].causes == ["hang"]  # later


def test_a_crash_at_the_same_place_gives_the_same_flight() -> None:
    short = SPEC.model_copy(update={"limits": Limits(mission_time_s=8.0)})
    with replaced("control", by="crashes") as server:
        first, second = fly(short, server).outcome, fly(short, server).outcome
    assert first.nodes["control"].result == "crash"
    assert first.nodes["control"].causes == ["SIGSEGV"]
    assert first.digest == second.digest
    assert first.qof == second.qof


AT_THE_END = SPEC.model_copy(update={"limits": Limits(mission_time_s=4.4)})
"""Perception that ``returns_late`` is there again 6 ms before, and the simulator does not wait for it."""


def test_a_node_that_comes_back_at_the_end_waits_for_nobody() -> None:
    """The simulator has ended: it will not be announced."""
    with replaced("perception", by="returns_late") as server:
        report = fly(AT_THE_END, server).outcome.nodes["perception"]
    assert (report.crashes, report.hangs, report.restarts) == (1, 0, 1)


def test_what_keeps_a_node_waiting_after_its_restart_is_no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(silence, "STALL_S", 0.5)
    fault = FaultSpec(level="source", target="collision_check.time_to_collision", seed=4)
    struck = AT_THE_END.model_copy(update={"fault": fault})
    with (
        replaced("perception", by="returns_late") as server,
        pytest.raises(InfrastructureError, match="no process sent a message"),
    ):
        fly(struck, server)


@pytest.mark.soak
def test_who_computes_for_long_is_not_to_blame_for_the_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even the node at which a fault is aimed: on a busy machine any step takes long."""
    monkeypatch.setattr(silence, "STALL_S", 2.0)
    never = FaultSpec(target="pid", trigger=Trigger(invocation=10**9))
    busy = MissionSpec(seed=7, fault=never, limits=Limits(mission_time_s=4.4, hang_cpu_s=20.0))
    with replaced("control", by="computes_long") as server:
        outcome = fly(busy, server).outcome
    assert (outcome.nodes["control"].hangs, outcome.nodes["control"].restarts) == (0, 0)
    assert outcome.result == "timeout"


def test_a_bug_of_ours_is_no_result() -> None:
    with replaced("control", by="raises") as server:
        with pytest.raises(InfrastructureError, match="wings fell off"):
            fly(SPEC, server)
        assert not forked(server.pid)
