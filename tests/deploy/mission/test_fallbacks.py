"""What is flown in the place of outputs that stay alarmed: re-execution finds them, and makes none again."""

import pytest

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.faults.specification import FaultSpec, Trigger
from services.models.mission import MissionSpec
from services.models.outcome import Outcome

WRONG_PRODUCTS = FaultSpec(
    target="pid", recurrence="permanent", opcodes=("vmulsd",), field="exponent", from_s=2.0
)
"""The controller's products are wrong from 2 s on."""


def mirrored(target: str, message: int) -> FaultSpec:
    """The signs of a vector or a number are wrong in one message."""
    at = Trigger(invocation=message)
    return FaultSpec(level="source", target=target, bit_numbers=(63,), components="all", trigger=at)


def flown(
    server: ForkServer, fault: FaultSpec, world: str = "sparse", limit_s: float = 45.0, **detector: str
) -> Outcome:
    spec = {"seed": 7, "world": world, "limits": {"mission_time_s": limit_s}, "fault": fault}
    judged = {"scheme": "reexecution", "retries": 0, **detector}
    return PairFlyer(server).fly(MissionSpec.model_validate({**spec, "detector": judged}))


def done(outcome: Outcome) -> dict[str, int]:
    """What was done about alarms, how often."""
    assert outcome.detection is not None
    assert {alarm.true for alarm in outcome.detection.alarms} == {True}
    report = outcome.detection.recovery
    return dict(report.actions.items()) if report is not None else {}


def test_a_vehicle_whose_controller_fails_collides_flies_on_by_the_simple_one_or_stands(
    server: ForkServer,
) -> None:
    ways = {"off": {"recovery": "off"}, "simple": {"control": "simple"}, "stop": {"control": "stop"}}
    found = {way: flown(server, WRONG_PRODUCTS, limit_s=6.0, **detector) for way, detector in ways.items()}
    assert {way: one.result for way, one in found.items()} == {
        "off": "collision",
        "simple": "timeout",
        "stop": "timeout",
    }
    assert {way: set(done(one)) for way, one in found.items()} == {
        "off": set(),
        "simple": {"simple"},
        "stop": {"stop"},
    }
    metres = {way: one.qof.distance_m for way, one in found.items()}
    assert metres["simple"] > metres["stop"] + 3.0


@pytest.mark.parametrize("fallback", ["trail", "last_good", "stop"])
def test_in_the_place_of_a_wrong_plan_the_vehicle_flies_back_or_on_or_stops(
    fallback: str, server: ForkServer
) -> None:
    outcome = flown(server, mirrored("trajectory.position", 1), "dense", planning=fallback)
    assert done(outcome) == {fallback: 1}
    assert outcome.result == "success"
    assert outcome.golden is not None
    assert (outcome.qof.distance_m > outcome.golden.qof.distance_m + 5.0) == (fallback == "trail")


def test_in_the_place_of_a_wrong_verdict_comes_one_that_has_the_vehicle_stop(server: ForkServer) -> None:
    outcome = flown(server, mirrored("collision_check.time_to_collision", 30), perception="stop")
    assert done(outcome) == {"stop": 1}
    assert outcome.golden is not None
    assert outcome.qof.replans == outcome.golden.qof.replans + 1
