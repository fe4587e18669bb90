"""A stage whose outputs are found wrong makes them again in flight: bounded, counted, in virtual time."""

from collections.abc import Iterator
from dataclasses import replace

import pytest

from deploy.config.platform import load_platform
from deploy.config.processes import STACK
from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from services.models.detection import DetectorSpec
from services.models.mission import MissionSpec
from services.runtime.latency import Latency
from tests.fixtures.nodes.detector_alarms import ALARMED_CHECKS

SPEC = MissionSpec(world="dense", seed=2)
RETRIES = 2


@pytest.fixture(scope="module")
def alarming() -> Iterator[ForkServer]:
    module = "tests.fixtures.nodes.detector_alarms"
    server = ForkServer({**STACK, "detector": replace(STACK["detector"], module=module)})
    yield server
    server.close()


@pytest.fixture(scope="module")
def golden(server: ForkServer) -> FlownMission:
    return fly(SPEC, server, keep_messages=True)


def asked(**fields: object) -> MissionSpec:
    given = {"scheme": "gaussian", "retries": RETRIES, **fields}
    return SPEC.model_copy(update={"detector": DetectorSpec.model_validate(given)})


@pytest.mark.soak
@pytest.mark.parametrize(
    ("stage", "topic", "kernels"),
    [
        ("perception", "collision_check", ("point_cloud", "octomap", "collision_check")),
        ("planning", "trajectory", ("rrt_star", "trajectory")),
        ("control", "command", ("pid",)),
    ],
)
def test_it_recomputes(
    stage: str, topic: str, kernels: tuple[str, ...], golden: FlownMission, alarming: ForkServer
) -> None:
    spec = asked(recovery=stage)
    first, second = (fly(spec, alarming, keep_messages=True) for _ in range(2))
    outcome, report = first.outcome, first.outcome.nodes[stage]
    assert outcome.result == "success"
    assert (report.alarms, report.recomputed) == (len(ALARMED_CHECKS), 1 + RETRIES)
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
    # Every alarm is told with what came of it; the stages that do not recover published all the same.
    assert outcome.detection is not None
    assert outcome.detection == second.outcome.detection
    told = [one for one in outcome.detection.alarms if one.stage == stage]
    assert [one.action for one in told] == ["recomputed"] * 3 + ["published"]
    assert [one.cost_ns >= least_ns for one in told] == [True] * 3 + [False]
    assert {one.action for one in outcome.detection.alarms if one.stage != stage} == {"published"}
    assert not any(one.true for one in outcome.detection.alarms)
    assert outcome.detection.recomputation_share > 0.0


@pytest.mark.soak
def test_with_the_gate_off_control_goes_on_to_the_next_waypoint(alarming: ForkServer) -> None:
    first, second = (fly(asked(gate="off"), alarming).outcome for _ in range(2))
    assert first.digest == second.digest
    assert first.result == "success"
    assert first.detection is not None
    actions: dict[str, list[str]] = {stage: [] for stage in ("perception", "planning", "control")}
    for one in first.detection.alarms:
        actions[one.stage].append(one.action)
    assert actions["perception"] == ["published"] * len(ALARMED_CHECKS)
    assert actions["control"] == ["waypoint_dropped"] * len(ALARMED_CHECKS)
    assert sum(report.recomputed for report in first.nodes.values()) == 0


@pytest.mark.soak
def test_with_the_gate_off_and_no_recovery_a_flight_is_only_watched(
    golden: FlownMission, alarming: ForkServer
) -> None:
    outcome = fly(asked(gate="off", recovery="off"), alarming).outcome
    assert outcome.digest == golden.outcome.digest
    assert outcome.detection is not None
    assert len(outcome.detection.alarms) >= 2 * len(ALARMED_CHECKS)
