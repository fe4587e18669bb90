"""Source-level faults in flight: they repeat, need no injector, and are compared with the golden twin."""

import pytest

from deploy.config.check import BadSpecError, check
from deploy.mission.fork_server import ForkServer
from deploy.mission.golden_twin import PairFlyer
from deploy.mission.replay import replay
from services.models.mission import FaultSpec, Limits, MissionSpec

SHORT = Limits(mission_time_s=6.0)


def spec(**fault: object) -> MissionSpec:
    given = FaultSpec.model_validate({"level": "source", **fault})
    return MissionSpec(seed=7, limits=SHORT, fault=given)


def test_a_struck_command_moves_the_vehicle_and_repeats(server: ForkServer) -> None:
    outcome = PairFlyer(server).fly(spec(target="command.vx", field="sign", seed=4))
    assert outcome.injection is not None
    assert outcome.injection.status == "injected"
    assert outcome.injection.node == "control"
    assert outcome.nodes["control"].result == "sdc"
    struck_s = outcome.injection.virtual_time_ns / 1e9
    assert outcome.topics["command"].diverged_at_s == pytest.approx(struck_s)
    moved_s = outcome.topics["odometry"].diverged_at_s
    assert moved_s is None or moved_s > struck_s
    assert replay(outcome, server).answer == "replayed"


def test_an_unknown_state_or_field_is_refused() -> None:
    with pytest.raises(BadSpecError, match="unknown inter-kernel state 'wings'"):
        check(spec(target="wings"))
    with pytest.raises(BadSpecError, match="32-bit integer"):
        check(spec(target="collision_check.future_collision_seq", field="sign"))
