"""The same stack at wall-clock speed: it arrives, survives a death, and claims no repetition."""

import pytest

from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.world import BoxWorld
from tests.deploy.mid_flight import fly_and_crash
from tests.deploy.mission.test_flight import assert_nothing_is_left

A_BOX_IN_THE_WAY = BoxWorld(
    name="box",
    kind="boxes",
    start=(-8.0, 5.0, 2.0),
    goal=(8.0, 5.0, 2.0),
    boxes=((-1.0, 2.0, 0.0, 1.0, 6.0, 9.0),),
)
SPEC = MissionSpec(world=A_BOX_IN_THE_WAY, clock="realtime")


def test_a_flight_takes_as_long_as_it_takes(server: ForkServer) -> None:
    virtual = fly(SPEC.model_copy(update={"clock": "lockstep"}), server).outcome
    outcome = fly(SPEC, server).outcome
    assert virtual.result == outcome.result == "success"
    assert outcome.wall_s > outcome.qof.flight_time_s
    assert outcome.qof.flight_time_s == pytest.approx(virtual.qof.flight_time_s, rel=0.5)
    # A frame each tick: nobody knows in advance when perception will be free.
    assert outcome.topics["depth"].messages == outcome.topics["odometry"].messages
    assert_nothing_is_left(server)


@pytest.mark.soak
def test_a_crashed_node_comes_back(server: ForkServer) -> None:
    outcome = fly_and_crash(server, SPEC, "planning").outcome
    assert outcome.nodes["planning"].result == "crash"
    assert outcome.nodes["planning"].restarts == 1
    assert outcome.result == "success"


@pytest.mark.soak
def test_nothing_is_said_of_messages_that_cannot_repeat(server: ForkServer) -> None:
    outcome = PairFlyer(server).fly(SPEC.model_copy(update={"fault": FaultSpec(target="octomap", seed=2)}))
    assert outcome.golden is not None
    assert outcome.golden.result == "success"
    assert {report.result for report in outcome.nodes.values()} <= {"unpaired", "crash", "hang"}
    assert all(topic.diverged_at_s is None for topic in outcome.topics.values())
