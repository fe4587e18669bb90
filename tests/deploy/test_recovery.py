"""A stage whose outputs are found wrong makes them again in flight: bounded, counted, in virtual time."""

from dataclasses import replace

import pytest

from deploy.forkserver import ForkServer
from deploy.mission import Flight, fly
from deploy.platform import load_platform
from deploy.stack import STACK
from services.bus.latency import Latency
from services.bus.mission import MissionSpec
from services.bus.recovery import RETRIES_MAX
from tests.fixtures.nodes.alarmed import ALARMED_CALLS

SPEC = MissionSpec(world="dense", seed=2)


@pytest.fixture(scope="module")
def golden(server: ForkServer) -> Flight:
    return fly(SPEC, server, keep_messages=True)


@pytest.mark.parametrize(
    ("stage", "topic", "kernels"),
    [
        ("perception", "collision_check", ("point_cloud", "octomap", "collision_check")),
        ("planning", "trajectory", ("rrt_star", "trajectory")),
        ("control", "command", ("pid",)),
    ],
)
def test_it_recomputes(stage: str, topic: str, kernels: tuple[str, ...], golden: Flight) -> None:
    server = ForkServer({**STACK, stage: replace(STACK[stage], module="tests.fixtures.nodes.alarmed")})
    try:
        first, second = (fly(SPEC, server, keep_messages=True) for _ in range(2))
    finally:
        server.close()
    outcome, report = first.outcome, first.outcome.nodes[stage]
    assert outcome.result == "success"
    assert (report.alarms, report.recomputed) == (len(ALARMED_CALLS), 1 + RETRIES_MAX)
    assert first.messages is not None
    assert golden.messages is not None
    # Every output is published once, however often it was made.
    outputs = report.kernels[kernels[-1]].invocations - report.recomputed
    assert len(first.messages[topic]) <= outputs
    # The first one was made twice, and that took the kernels' time.
    platform = load_platform(SPEC.platform)
    least_ns = sum(Latency(platform.kernels[name], SPEC.seed, name, 0).least_ns for name in kernels)
    assert first.messages[topic][0].ready_ns - golden.messages[topic][0].ready_ns >= least_ns > 0
    assert outcome.digest == second.outcome.digest != golden.outcome.digest
