"""Messages settle in one order, whatever arrives first; events find their place, late ones are counted."""

import random

from deploy.recording.ordering import HELD_NS, MessageOrder, SentMessage
from deploy.recording.recorder import FlightRecorder
from services.bus.horizon import NEVER_NS, Promise, Stamped
from services.bus.topics import STAGES, TICK_NS, published_by

TICKS = 300


def hear(recorder: FlightRecorder, stage: str, serial: int, counts: dict[str, int], until_ns: int) -> None:
    topics = published_by(stage)
    count = tuple(counts.get(topic.name, 0) for topic in topics)
    recorder.hear(stage, Promise(serial, 0, 0, (until_ns,) * len(topics), count).packed())


def flight(
    seed: int, held: bool, injected_at: int | None = None, told_at: int = 0
) -> tuple[list[SentMessage], int]:
    """A flight whose messages of a tick come in a random order; the injection is told at another tick."""
    recorder, found = FlightRecorder(), []
    settling = MessageOrder(recorder, held=held, realtime=False)
    draw = random.Random(seed)  # noqa: S311 - no secret
    for tick in range(TICKS):
        said = [("odometry", tick * TICK_NS), ("command", tick * TICK_NS + 7), ("imu", tick * TICK_NS)]
        draw.shuffle(said)
        for topic, at_ns in said:
            recorder.record(topic, Stamped(tick, at_ns, topic.encode()))
        counts = {"odometry": tick + 1, "imu": tick + 1, "command": tick + 1}
        for stage in draw.sample(STAGES, len(STAGES)):
            hear(recorder, stage, tick + 1, counts, (tick + 1) * TICK_NS)
            found += settling.take(NEVER_NS)
        if injected_at is not None and tick == told_at:
            settling.tell("injection", injected_at * TICK_NS, b"struck")
    return found + settling.rest((TICKS - 1) * TICK_NS), settling.late


def test_the_order_does_not_depend_on_what_arrives_first() -> None:
    first, _ = flight(1, held=False)
    assert first == flight(2, held=False)[0] == flight(3, held=True)[0]
    assert [one.topic for one in first[:4]] == ["odometry", "imu", "command", "odometry"]
    times = [one.message.ready_ns for one in first]
    assert times == sorted(times)
    assert max(times) == (TICKS - 1) * TICK_NS  # the command after the end is not of the flight


def test_an_injection_that_is_told_late_still_finds_its_place() -> None:
    ticks = HELD_NS // TICK_NS
    found, late = flight(1, held=True, injected_at=50, told_at=50 + ticks - 5)
    place = [one.topic for one in found].index("injection")
    assert (found[place - 1].message.ready_ns, late) == (50 * TICK_NS, 0)
    assert found[place + 1].message.ready_ns > 50 * TICK_NS


def test_one_that_is_told_too_late_is_kept_and_counted() -> None:
    found, late = flight(1, held=True, injected_at=50, told_at=50 + HELD_NS // TICK_NS + 50)
    assert late == 1
    (injection,) = (one for one in found if one.topic == "injection")
    assert injection.message.ready_ns == 50 * TICK_NS
