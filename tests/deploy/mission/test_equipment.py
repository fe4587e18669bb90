"""Sensors and motors that fail in flight: read back, with the effect to be expected, and repeated."""

import pytest

from deploy.config.check import check
from deploy.errors import BadSpecError
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.pairing.replay import replay
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from services.models.outcome import Outcome


def flown(server: ForkServer, level: str, target: str, **fields: object) -> Outcome:
    fault = FaultSpec.model_validate({"level": level, "target": target, "from_s": 2.0, **fields})
    return PairFlyer(server).fly(MissionSpec(seed=1, limits=Limits(mission_time_s=12.0), fault=fault))


def test_a_position_that_is_off_leads_the_vehicle_off_by_as_much(server: ForkServer) -> None:
    outcome = flown(server, "sensor", "odometry", model="wrong", size=4.0, until_s=6.0)
    record = outcome.injection
    assert record is not None
    assert (record.status, record.node, record.state) == ("injected", "sim", ["odometry"])
    assert record.strikes == 100
    assert record.before != record.after == record.read_back
    assert outcome.topics["odometry"].diverged_at_s == pytest.approx(2.0)
    assert outcome.nodes["control"].result == "sdc"
    assert replay(outcome, server).answer == "replayed"


def test_a_blind_camera_finds_nothing_to_avoid(server: ForkServer) -> None:
    outcome = flown(server, "sensor", "depth", model="off")
    assert outcome.golden is not None
    assert outcome.topics["depth"].messages < 30
    assert outcome.qof.min_clearance_m <= outcome.golden.qof.min_clearance_m


def test_without_odometry_the_vehicle_flies_on_as_it_was_told(server: ForkServer) -> None:
    outcome = flown(server, "sensor", "odometry", model="off", until_s=5.0)
    assert outcome.topics["command"].messages < outcome.topics["imu"].messages - 60
    assert outcome.nodes["control"].crashes == 0


def test_a_dead_motor_ends_the_flight(server: ForkServer) -> None:
    outcome = flown(server, "actuator", "motor1", model="off")
    assert outcome.result == "collision"
    assert outcome.injection is not None
    assert outcome.injection.after == outcome.injection.read_back == "0 N"
    assert replay(outcome, server).answer == "replayed"


@pytest.mark.parametrize(
    ("level", "target", "fields", "says"),
    [
        ("sensor", "lidar", {"model": "off"}, "unknown sensor 'lidar'; known: depth, odometry, imu"),
        ("actuator", "motor9", {"model": "off"}, "unknown actuator 'motor9'"),
        ("sensor", "depth", {}, "go with level sensor or actuator"),
        ("sensor", "depth", {"model": "wrong"}, "size goes with"),
        ("sensor", "depth", {"model": "intermittent"}, "probability go together"),
        ("sensor", "depth", {"model": "delayed", "size": 0.0}, "more than 0"),
        ("sensor", "depth", {"model": "off", "field": "sign"}, "field: not of a sensor or motor"),
        ("source", "command.vx", {"model": "off"}, "go with level sensor or actuator"),
    ],
)
def test_what_makes_no_sense_is_refused(
    level: str, target: str, fields: dict[str, object], says: str
) -> None:
    with pytest.raises((ValueError, BadSpecError), match=says):
        check(MissionSpec(fault=FaultSpec.model_validate({"level": level, "target": target, **fields})))
