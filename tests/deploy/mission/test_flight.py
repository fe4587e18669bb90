"""Whole flights over real processes and real Zenoh: they repeat, and they survive the death of a node."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from deploy.errors import DisturbedFlightError, InfrastructureError
from deploy.mission import silence, supervisor
from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from services.models.faults.specification import FaultSpec, Trigger
from services.models.mission import Limits, MissionSpec
from services.system.signal_names import signal_name
from tests.conftest import descendants, folders, forked, segments
from tests.deploy.mid_flight import fly_and, fly_and_crash, fly_and_kill

SPEC = MissionSpec(world="sparse", seed=7)


@pytest.fixture(scope="module")
def golden(server: ForkServer) -> FlownMission:
    return fly(SPEC, server)


@contextmanager
def load(processors: int) -> Iterator[None]:
    """Keep ``processors`` busy."""
    children = []
    for _ in range(processors):
        child = os.fork()
        if child == 0:
            while True:
                pass
        children.append(child)
    try:
        yield
    finally:
        for child in children:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)


def assert_nothing_is_left(server: ForkServer) -> None:
    assert not forked(server.pid)
    assert not folders(os.getpid())


def test_a_golden_flight_arrives_without_collision(golden: FlownMission) -> None:
    qof = golden.outcome.qof
    assert golden.outcome.result == "success"
    assert qof.success
    assert 45.0 < qof.distance_m < 75.0
    assert qof.min_clearance_m > 0.5
    assert {report.result for report in golden.outcome.nodes.values()} == {"golden"}


def test_the_same_specification_gives_the_same_bytes(golden: FlownMission, server: ForkServer) -> None:
    again = fly(SPEC, server).outcome
    assert again.digest == golden.outcome.digest
    assert again.qof == golden.outcome.qof


def test_a_loaded_machine_changes_nothing(golden: FlownMission, server: ForkServer) -> None:
    with load(2 * len(os.sched_getaffinity(0))):
        again = fly(SPEC, server).outcome
    assert again.digest == golden.outcome.digest
    assert again.qof == golden.outcome.qof


def test_another_seed_gives_another_flight(golden: FlownMission, server: ForkServer) -> None:
    other = fly(SPEC.model_copy(update={"seed": 8}), server).outcome
    assert other.digest != golden.outcome.digest


@pytest.mark.parametrize("platform", ["ideal"])
def test_a_platform_without_latency_repeats_too(platform: str, server: ForkServer) -> None:
    spec = SPEC.model_copy(update={"platform": platform, "limits": Limits(mission_time_s=3.0)})
    first, second = fly(spec, server).outcome, fly(spec, server).outcome
    assert first.result == "timeout"
    assert first.digest == second.digest


@pytest.mark.parametrize("name", ["perception", "planning", "control"])
def test_a_crashed_node_is_a_result_and_comes_back(name: str, server: ForkServer) -> None:
    flown = fly_and_crash(server, SPEC, name)
    report = flown.outcome.nodes[name]
    assert report.result == "crash"
    assert report.causes == ["SIGSEGV"]
    assert report.restarts == 1
    assert flown.outcome.result == "success"
    assert_nothing_is_left(server)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("perception", signal.SIGKILL),
        ("planning", signal.SIGSEGV),
        ("control", signal.SIGTERM),
        ("sim", signal.SIGKILL),
        ("control", signal.SIGRTMIN + 6),
    ],
)
def test_a_node_that_somebody_ends_makes_no_outcome(name: str, number: int, server: ForkServer) -> None:
    how = signal_name(number).replace("+", "[+]")
    with pytest.raises(DisturbedFlightError, match=f"{name} was ended from outside .{how}"):
        fly_and_kill(server, SPEC, name, number)
    assert_nothing_is_left(server)


def test_a_node_that_somebody_stops_makes_no_outcome(
    server: ForkServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(silence, "STALL_S", 0.5)
    with pytest.raises(DisturbedFlightError, match="planning was stopped from outside"):
        fly_and_kill(server, SPEC, "planning", signal.SIGSTOP)
    assert_nothing_is_left(server)


def stop_proxy_of(name: str) -> None:
    proxies = [pid for pid, called in descendants(os.getpid()).items() if called == f"proxy-{name}"]
    os.kill(proxies[0], signal.SIGSTOP)


def test_a_proxy_that_somebody_stops_makes_no_outcome(
    server: ForkServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The struck node is silent as well, and not to blame."""
    monkeypatch.setattr(silence, "STALL_S", 2.0)
    never = FaultSpec(target="pid", trigger=Trigger(invocation=10**9))

    with pytest.raises(DisturbedFlightError, match="the proxy of planning was stopped from outside"):
        fly_and(server, SPEC.model_copy(update={"fault": never}), lambda: stop_proxy_of("planning"))
    assert_nothing_is_left(server)


def test_a_proxy_that_stays_stopped_is_not_waited_for_without_end(
    server: ForkServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is stopped instead of the mission: later it would race its node, which ends by itself."""
    monkeypatch.setattr("deploy.mission.flight._Mission._run", lambda *_: stop_proxy_of("planning"))
    monkeypatch.setattr("deploy.mission.flight.GRACE_S", 0.0)
    monkeypatch.setattr(supervisor, "LEFT_S", 3.0)
    with pytest.raises(InfrastructureError, match=r"planning.*: not gone 3 s after the mission"):
        fly(SPEC, server)
    assert_nothing_is_left(server)


def test_no_process_of_a_flight_has_shared_memory_that_it_could_leave(server: ForkServer) -> None:
    found = []
    before = segments([os.getpid()])
    fly_and(server, SPEC, lambda: found.append(segments([os.getpid(), *descendants(os.getpid())])))
    assert found == [before]


def test_a_node_without_a_restart_left_stays_down(server: ForkServer) -> None:
    spec = SPEC.model_copy(update={"limits": Limits(restarts=0, mission_time_s=60.0)})
    flown = fly_and_crash(server, spec, "control")
    assert flown.outcome.nodes["control"].result == "crash"
    assert flown.outcome.result in ("collision", "timeout", "no_path")


def test_a_crashed_simulator_ends_the_mission(server: ForkServer) -> None:
    flown = fly_and_crash(server, SPEC, "sim")
    assert flown.outcome.result == "stack_failure"
    assert flown.outcome.reason == "sim: SIGSEGV"
    assert flown.outcome.qof.flight_time_s > 0
    assert_nothing_is_left(server)
