"""What is drawn of a world in which obstacles move."""

from __future__ import annotations

import numpy as np
import pytest

from deploy.recording.derived import DERIVED, DerivedMessages
from deploy.recording.ordering import SentMessage
from deploy.recording.visualization import MOVING_PERIOD_NS
from services.bus.horizon import Stamped
from services.bus.messages import decode, encode, header
from services.bus.topics import TOPICS
from services.models.mission import MissionSpec
from sim.flight import SimulatedFlight
from sim.sensors import telemetry
from sim.world import make_world

TICK_NS = 40_000_000


def drawn(world: str, ticks: int) -> dict[str, list[tuple[int, object]]]:
    """What is drawn of a vehicle that hovers for some ticks, by topic, with its time."""
    spec = MissionSpec(world=world, seed=3)
    flight, view = SimulatedFlight(spec), DerivedMessages(spec)
    found: dict[str, list[tuple[int, object]]] = {}

    def send(topic: str, at_ns: int, message: object) -> None:
        payload = encode(message, TOPICS[topic].type)
        for one in view.of(SentMessage(topic, Stamped(0, at_ns, payload))):
            told = decode(one.message.payload, DERIVED[one.topic].type)
            found.setdefault(one.topic, []).append((one.message.ready_ns, told))

    send("goal", 0, telemetry.goal(header(0, "map"), flight.world))
    for tick in range(ticks):
        at_ns = tick * TICK_NS
        pose = telemetry.odometry(header(at_ns, "odom"), flight.vehicle, flight.drift)
        send("odometry", at_ns, pose)
    return found


def test_moving_obstacles_are_drawn_where_they_are_and_not_twice() -> None:
    found, world = drawn("traffic", 11), make_world("traffic", 3)
    ((_, standing),) = found["obstacles"]
    assert len(standing.markers) == len(world.fixed)  # type: ignore[attr-defined]
    times = [at_ns for at_ns, _ in found["moving_obstacles"]]
    assert times == [0, MOVING_PERIOD_NS, 2 * MOVING_PERIOD_NS]
    for at_ns, told in found["moving_obstacles"]:
        places = [
            (one.pose.position.x, one.pose.position.y, one.pose.position.z)
            for one in told.markers  # type: ignore[attr-defined]
        ]
        boxes = world.moved(at_ns / 1e9)
        assert np.array(places) == pytest.approx((boxes[:, :3] + boxes[:, 3:]) / 2)


def test_where_nothing_moves_nothing_moving_is_drawn() -> None:
    assert "moving_obstacles" not in drawn("sparse", 11)
