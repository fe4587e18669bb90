"""What is flown in the place of outputs that stay alarmed."""

import pytest

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.outcome import Outcome

REVERSED = {"level": "source", "recurrence": "permanent", "bit_numbers": (63,), "components": "all"}


def flown(server: ForkServer, target: str, **detector: object) -> Outcome:
    spec = MissionSpec.model_validate(
        {
            "seed": 7,
            "limits": {"mission_time_s": 45.0},
            "fault": FaultSpec(target=target, **REVERSED),
            "detector": {"scheme": "reexecution", "retries": 0, **detector},
        }
    )
    return PairFlyer(server).fly(spec)


def actions(outcome: Outcome, stage: str) -> set[str]:
    assert outcome.detection is not None
    return {alarm.action for alarm in outcome.detection.alarms if alarm.stage == stage}


def test_a_mission_whose_commands_are_all_reversed_succeeds_by_the_simple_controller(
    server: ForkServer,
) -> None:
    lost = flown(server, "command.velocity", recovery="off")
    assert not lost.qof.success
    outcome = flown(server, "command.velocity", control="simple")
    assert actions(outcome, "control") == {"simple"}
    assert outcome.result == "success"
    assert flown(server, "command.velocity", control="simple").digest == outcome.digest


@pytest.mark.parametrize("fallback", ["stop", "last_good"])
def test_a_vehicle_whose_commands_are_not_flown_stands_or_goes_on(fallback: str, server: ForkServer) -> None:
    outcome = flown(server, "command.velocity", control=fallback)
    assert fallback in actions(outcome, "control")
    assert (outcome.qof.distance_m < 0.5) == (fallback == "stop")


def test_plans_that_are_wrong_lead_back_along_the_trail_and_into_nothing(server: ForkServer) -> None:
    outcome = flown(server, "trajectory.position", planning="trail")
    assert "trail" in actions(outcome, "planning")
    assert outcome.qof.min_clearance_m > 0.0
    assert outcome.result != "collision"


def test_a_verdict_that_is_wrong_has_the_vehicle_stop(server: ForkServer) -> None:
    outcome = flown(server, "collision_check.time_to_collision", perception="stop", planning="stop")
    assert actions(outcome, "perception") == {"stop"}
    assert outcome.result != "collision"
