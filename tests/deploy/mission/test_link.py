"""A link that delays and loses, in flights: later by as much, counted, repeated, replayed."""

import pytest

from deploy.config.check import check
from deploy.errors import BadSpecError
from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.pairing.replay import replay
from services.bus.horizon import Stamped
from services.bus.messages import decode
from services.bus.topics import OVER_LINK, TICK_NS, TOPICS
from services.models.equipment import Link
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec

SHORT = MissionSpec(seed=7, limits=Limits(mission_time_s=8.0))
DELAY_NS = 60_000_000
LATE = SHORT.model_copy(update={"link": Link(delay_ms=DELAY_NS / 1e6)})
LOSSY = SHORT.model_copy(update={"link": Link(delay_ms=15.0, loss=0.1)})


@pytest.fixture(scope="module")
def late(server: ForkServer) -> FlownMission:
    return fly(LATE, server, keep_messages=True)


@pytest.fixture(scope="module")
def lossy(server: ForkServer) -> FlownMission:
    return fly(LOSSY, server, keep_messages=True)


def made_ns(topic: str, message: Stamped) -> int:
    stamp = decode(message.payload, TOPICS[topic].type).header.stamp
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def test_each_message_over_the_link_comes_that_much_later(late: FlownMission) -> None:
    assert late.messages is not None
    for topic in OVER_LINK - {"imu"}:
        apart = {one.ready_ns - made_ns(topic, one) for one in late.messages[topic]}
        assert apart == {DELAY_NS}, topic
    assert {one.ready_ns % TICK_NS for one in late.messages["imu"]} == {DELAY_NS % TICK_NS}


def test_what_perception_made_of_a_frame_says_when_it_was_taken(late: FlownMission) -> None:
    assert late.messages is not None
    taken = {made_ns("depth", one) for one in late.messages["depth"]}
    for topic in ("cloud", "map"):
        assert {made_ns(topic, one) for one in late.messages[topic]} <= taken


def test_the_first_command_comes_two_delays_later(late: FlownMission, server: ForkServer) -> None:
    prompt = fly(SHORT, server, keep_messages=True)
    assert prompt.messages is not None
    assert late.messages is not None
    first, second = (one.messages["command"][0].ready_ns for one in (prompt, late))  # type: ignore[index]
    assert second == first + 2 * DELAY_NS


def test_what_is_lost_is_counted_and_seen_by_nobody(lossy: FlownMission) -> None:
    nodes, topics = lossy.outcome.nodes, lossy.outcome.topics
    heard = topics["odometry"].messages
    assert nodes["control"].steps == heard
    assert 0.8 < heard / nodes["sim"].steps < 0.97
    sent = [topics[name].messages for name in ("odometry", "imu", "depth")]
    made = 3 * (nodes["sim"].steps + 2)  # the first tick is before the first step, the last one under way
    under_way = made - sum(sent) - nodes["sim"].lost
    assert 0 <= under_way <= 6  # of the last two ticks
    assert nodes["control"].lost == heard - topics["command"].messages > 0


def test_the_flight_repeats_and_its_golden_twin_loses_the_same(
    lossy: FlownMission, server: ForkServer
) -> None:
    fault = FaultSpec(target="pid", model="none")
    struck = PairFlyer(server).fly(LOSSY.model_copy(update={"fault": fault}))
    assert struck.digest == lossy.outcome.digest
    assert struck.nodes["sim"].lost == lossy.outcome.nodes["sim"].lost


def test_an_injected_flight_replays(server: ForkServer) -> None:
    outcome = PairFlyer(server).fly(LOSSY.model_copy(update={"fault": FaultSpec(target="pid", seed=3)}))
    assert outcome.injection is not None
    assert outcome.injection.status == "injected"
    assert replay(outcome, server).answer == "replayed"


def test_a_stage_that_crashes_comes_back_behind_the_link(server: ForkServer) -> None:
    fault = FaultSpec(target="rrt_star", model="opcode", bits=4)
    first, second = (PairFlyer(server).fly(LOSSY.model_copy(update={"fault": fault})) for _ in range(2))
    assert first.nodes["planning"].restarts > 0
    assert first.digest == second.digest


def test_in_real_time_there_is_none() -> None:
    with pytest.raises(BadSpecError, match="leave out --clock realtime"):
        check(LATE.model_copy(update={"clock": "realtime"}))
