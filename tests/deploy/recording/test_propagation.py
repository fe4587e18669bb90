"""Where faults of known effect pass on to, on real flights, and the graph of it."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import services
from dashboard.analysis.propagation import edges
from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from deploy.recording.propagation import FAULT, growth, propagation
from services.bus.horizon import Stamped
from services.bus.messages import Image, decode, encode, header
from services.bus.topics import MADE_FROM, RECORDED, TICK_NS, TOPICS
from services.models.faults.specification import FaultSpec, Trigger
from services.models.inter_kernel_states import members
from services.models.mission import Limits, MissionSpec
from services.models.propagation import Propagation

GOLDEN = MissionSpec(seed=7, limits=Limits(mission_time_s=12.0))

# What strikes, in which message, which bits; how far it must come: "alone" the topic that was struck, "map"
# what perception makes of it, "loop" to the command and round the loop. Flipping the lowest bit moves a point
# by less than a voxel, one of the exponent by its distance; no trajectory is flown by its accelerations; a
# changed command moves the vehicle.
COMMAND = ("command.vx", "command.vy", "command.vz", "command.yaw_rate")
CASES: list[tuple[str, int, dict[str, Any], str]] = [
    *((state, 40, {"field": "sign"}, "loop") for state in COMMAND),
    *((state, 200, {"bit_numbers": [30]}, "loop") for state in COMMAND),
    *((f"cloud.{axis}", 30, {"bit_numbers": [0]}, "alone") for axis in "xyz"),
    ("cloud.x", 5, {"field": "exponent"}, "map"),
    *((f"trajectory.{state}", 0, {"bit_numbers": [51], "point": 40}, "loop") for state in "xyz"),
    ("trajectory.vx", 0, {"bit_numbers": [62], "point": 40}, "loop"),
    *((f"trajectory.{state}", 0, {"bit_numbers": [3], "point": 10}, "alone") for state in ("ax", "ay")),
    ("collision_check.time_to_collision", 20, {"bit_numbers": [0]}, "alone"),
    ("collision_check.future_collision_seq", 30, {"bit_numbers": [0]}, "loop"),
]


@pytest.fixture(scope="module")
def twin(server: ForkServer) -> FlownMission:
    return fly(GOLDEN, server, keep_messages=True)


def struck(server: ForkServer, target: str, number: int, **fields: Any) -> FlownMission:
    fault = FaultSpec(level="source", target=target, trigger=Trigger(invocation=number), **fields)
    return fly(GOLDEN.model_copy(update={"fault": fault}), server, keep_messages=True)


def told(flight: FlownMission, twin: FlownMission) -> Propagation:
    assert flight.messages is not None
    assert twin.messages is not None
    return propagation(flight.messages, twin.messages, flight.outcome.injection)


def test_there_are_twenty_cases() -> None:
    assert len(CASES) == 20


@pytest.mark.soak
@pytest.mark.parametrize(("target", "number", "fields", "reach"), CASES)
def test_a_fault_of_known_effect_is_told_right(
    server: ForkServer, twin: FlownMission, target: str, number: int, fields: dict[str, Any], reach: str
) -> None:
    flight = struck(server, target, number, **fields)
    injection, found = flight.outcome.injection, told(flight, twin)
    assert injection is not None
    assert injection.status == "injected"
    state = members(target)[0]
    # First of all the topic that was struck strays: in that message, in that number, at that moment.
    first = found.topics[0]
    assert flight.messages is not None
    assert twin.messages is not None
    sent = flight.messages[state.topic][number]
    assert (first.topic, first.stage, first.message) == (state.topic, state.stage, number)
    assert first.at_ns == sent.ready_ns
    assert first.tick == sent.ready_ns // TICK_NS
    assert first.causes == [FAULT]
    assert first.fields == [target.partition(".")[2] if state.stride else ".".join(state.path)] or (
        state.topic == "cloud" and first.fields == [target.partition(".")[2]]
    )
    assert found.struck_stage == state.stage
    assert found.struck_at_ns == injection.virtual_time_ns
    # What was published before is the twin's, and what strays later has a cause that strayed before it.
    began = {one.topic: one.at_ns for one in found.topics}
    for one in found.topics:
        before = [m for m in flight.messages[one.topic] if m.ready_ns < one.at_ns]
        assert before == twin.messages[one.topic][: len(before)]
        assert one.causes
        assert all(cause == FAULT or began[cause] <= one.at_ns for cause in one.causes)
    assert sorted([*began, *found.same]) == sorted(topic.name for topic in RECORDED)
    assert all(flight.messages[topic] == twin.messages[topic] for topic in found.same)
    # How far it comes; once the command has strayed the vehicle moves otherwise at the next tick.
    assert found.command_at_ns == began.get("command")
    if reach == "loop":
        assert found.command_at_ns is not None
        assert found.delay_ns is not None
        assert found.delay_ns >= 0
        assert began["odometry"] == (found.command_at_ns // TICK_NS + 1) * TICK_NS
    else:
        assert set(began) == ({state.topic} if reach == "alone" else {"cloud", "map"})


@pytest.fixture(scope="module")
def turned(server: ForkServer) -> FlownMission:
    """It is sent back for a tick."""
    return struck(server, "command.vx", 40, field="sign")


def test_deviations_are_what_the_messages_say(turned: FlownMission, twin: FlownMission) -> None:
    flight, found = turned, told(turned, twin)
    assert flight.messages is not None
    assert twin.messages is not None
    one, other = (
        decode(messages["command"][40].payload, TOPICS["command"].type).twist.linear
        for messages in (flight.messages, twin.messages)
    )
    first = found.topics[0]
    assert first.unit == "m/s"
    assert first.first == pytest.approx(abs(one.x - other.x))
    grown = growth("odometry", flight.messages, twin.messages)
    assert all(point.deviation == 0.0 for point in grown if point.at_ns <= 40 * TICK_NS)
    (odometry,) = (one for one in found.topics if one.topic == "odometry")
    deviations = [point.deviation or 0.0 for point in grown]
    assert odometry.largest == max(deviations) > 0.0
    assert odometry.last == deviations[-1]


@pytest.mark.parametrize(("depth_m", "apart_m"), [(-math.inf, 2.0), (math.inf, 18.0), (2.5, 0.5)])
def test_a_pixel_that_is_too_close_counts_as_no_distance(depth_m: float, apart_m: float) -> None:
    one, other = ({"depth": [Stamped(0, 0, image(depth))], "goal": []} for depth in (depth_m, 2.0))
    assert [point.deviation for point in growth("depth", one, other)] == [pytest.approx(apart_m)]


def image(depth_m: float) -> bytes:
    """A depth image of one pixel."""
    pixel = np.array([depth_m], np.float32).view(np.uint8)
    return encode(Image(header(0, "camera"), 1, 1, "32FC1", 0, 4, pixel), TOPICS["depth"].type)


def test_a_flight_is_the_same_as_itself(twin: FlownMission) -> None:
    found = told(twin, twin)
    assert (found.topics, found.command_at_ns, found.struck_at_ns) == ([], None, None)
    assert found.same == [topic.name for topic in RECORDED]


def test_the_graph_has_a_way_from_the_fault_to_every_topic(turned: FlownMission, twin: FlownMission) -> None:
    found = told(turned, twin)
    reached, ways = {FAULT}, edges(found)
    for _ in ways:
        reached |= {way.target for way in ways if way.source in reached}
    assert reached == {FAULT, *(one.topic for one in found.topics)}
    assert all(way.delay_ns >= 0 for way in ways)


def test_nonsense_has_no_deviation_but_is_told(twin: FlownMission) -> None:
    assert twin.messages is not None
    message = decode(twin.messages["command"][40].payload, TOPICS["command"].type)
    message.twist.linear.x = math.nan
    sent = list(twin.messages["command"])
    sent[40] = Stamped(40, sent[40].ready_ns, encode(message, TOPICS["command"].type))
    (command,) = propagation({**twin.messages, "command": sent}, twin.messages).topics
    assert (command.topic, command.message, command.fields) == ("command", 40, ["twist.linear.x"])
    assert (command.first, command.largest) == (None, None)
    assert command.causes == []


def stages() -> Iterator[tuple[str, set[str]]]:
    for stage in dict.fromkeys(topic.publisher for topic in RECORDED):
        made = [topic.name for topic in RECORDED if topic.publisher == stage]
        yield stage, {source for name in made for source in MADE_FROM[name]} - set(made)


def test_the_ways_are_what_the_nodes_listen_to() -> None:
    root = Path(services.__file__).parent
    for stage, sources in stages():
        file = root.parent / "sim" / "node.py" if stage == "sim" else root / stage / "node.py"
        assert set(re.findall(r'\.input\(\s*"(\w+)"', file.read_text())) == sources, stage
