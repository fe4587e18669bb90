"""A recorded flight answers a node as its proxy did, and notices the first message that is another one."""

import json

import pytest

from injector.strikes.recorded_bus import EndOfRecordingError, RecordedBus, StrayedError, UnrecordedError
from services.bus import proxy_link
from services.bus.horizon import Stamped
from services.bus.proxy_link import ANSWER, Frame, NonsenseError
from services.bus.topics import RECORDED, TOPICS

END_NS = 100
NUMBERS = {name: number for number, name in enumerate(TOPICS)}
SENT = {"odometry": (10, 20, 30, 90, 100), "collision_check": (25, 30), "command": (12, 23, 33, 92)}
INPUTS = ["odometry", "collision_check"]


def recorded() -> RecordedBus:
    messages = {
        topic.name: [
            Stamped(seq, ready_ns, f"{topic.name} {seq}".encode())
            for seq, ready_ns in enumerate(SENT.get(topic.name, ()))
        ]
        for topic in RECORDED
    }
    bus = RecordedBus("control", messages, END_NS)
    assert bus.take(said(proxy_link.READY, payload=json.dumps({"inputs": INPUTS}).encode())) is not None
    return bus


def said(kind: int, place: int = 0, first: int = 0, payload: bytes = b"") -> Frame:
    return Frame(kind, place, first, 0, payload)


def next_after(bus: RecordedBus, busy_until_ns: int) -> tuple[int, int, list[tuple[int, int]]]:
    """When the node begins its step, how many triggers it has missed, what it sees: input and number."""
    answer = bus.take(said(proxy_link.NEXT, 0, busy_until_ns))
    assert answer is not None
    size, dropped, start = ANSWER.unpack(answer[: ANSWER.size])
    body = answer[ANSWER.size :]
    assert len(body) == size
    return start, dropped, [(place, one.seq) for place, one in proxy_link.unpack(body)]


def put(bus: RecordedBus, number: int, ready_ns: int, text: str = "") -> None:
    payload = (text or f"command {number}").encode()
    assert bus.take(said(proxy_link.PUT, NUMBERS["command"], ready_ns, payload)) is None


def test_a_free_node_begins_with_the_oldest_trigger() -> None:
    assert next_after(recorded(), 0) == (10, 0, [(0, 0)])


def test_a_busy_node_begins_when_it_is_free_with_the_newest_trigger_and_what_came_meanwhile() -> None:
    assert next_after(recorded(), 30) == (30, 2, [(0, 2), (1, 0), (1, 1)])


def test_a_copy_goes_its_own_way() -> None:
    bus = recorded()
    twin = bus.copy()
    put(twin, 0, 12)
    next_after(twin, 0)
    put(bus, 0, 12)
    assert next_after(bus, 0) == (10, 0, [(0, 0)])


def test_what_was_sent_in_the_flight_may_be_sent() -> None:
    bus = recorded()
    for number, ready_ns in enumerate(SENT["command"]):
        put(bus, number, ready_ns)
    put(bus, 4, END_NS + 3, "what the flight did not last for")


@pytest.mark.parametrize(("ready_ns", "text"), [(23, "another"), (24, ""), (22, "")])
def test_another_message_or_another_time_is_noticed(ready_ns: int, text: str) -> None:
    bus = recorded()
    put(bus, 0, 12)
    with pytest.raises(StrayedError) as noticed:
        put(bus, 1, ready_ns, text)
    assert noticed.value.strayed == ("command", 1, min(ready_ns, 23))


def test_one_message_more_is_noticed() -> None:
    bus = recorded()
    for number, ready_ns in enumerate(SENT["command"]):
        put(bus, number, ready_ns)
    with pytest.raises(StrayedError):
        put(bus, 4, END_NS)


def test_the_flight_ends_where_the_node_would_begin_after_it() -> None:
    bus = recorded()
    for number, ready_ns in enumerate(SENT["command"]):
        put(bus, number, ready_ns)
    assert next_after(bus, END_NS)[0] == END_NS
    with pytest.raises(EndOfRecordingError):
        next_after(bus, END_NS + 1)


def test_one_message_less_is_noticed_at_the_end() -> None:
    bus = recorded()
    put(bus, 0, 12)
    with pytest.raises(StrayedError) as noticed:
        next_after(bus, END_NS + 1)
    assert noticed.value.strayed == ("command", 1, 23)


def test_what_no_node_says_is_refused() -> None:
    bus = recorded()
    with pytest.raises(NonsenseError):
        bus.take(said(proxy_link.PUT, NUMBERS["odometry"], 10))
    with pytest.raises(NonsenseError):
        bus.take(said(proxy_link.PUT, 200, 10))
    with pytest.raises(NonsenseError):
        bus.take(said(proxy_link.NEXT, 7))
    with pytest.raises(UnrecordedError):
        bus.take(said(proxy_link.ASK, payload=b"alarm/control\0"))


def ask(bus: RecordedBus, question: bytes) -> bytes | None:
    return bus.take(said(proxy_link.ASK, payload=b"verdict/control\0" + question))


def test_the_detector_answers_what_it_was_asked_in_the_flight_and_nothing_else() -> None:
    bus = recorded()
    learning = bus.learning()
    assert ask(learning, b"one") == ask(learning, b"two") == ANSWER.pack(0, 0, 1)
    twin = bus.copy()
    assert ask(bus, b"one") == ANSWER.pack(0, 0, 1)
    with pytest.raises(UnrecordedError, match="another output"):
        ask(twin, b"two")
    assert ask(bus, b"two") is not None
    with pytest.raises(UnrecordedError, match="another output"):
        ask(bus, b"three")
