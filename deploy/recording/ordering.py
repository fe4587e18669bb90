"""The messages of a flight in the one order that each of its repetitions has, while it is under way."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from deploy.recording.recorder import FlightRecorder
from services.bus.horizon import Stamped
from services.bus.topics import RECORDED, TICK_NS, TOPICS

HELD_NS = 5_000_000_000
"""For how long messages are held back for events that come late: the injection, and alarms. Virtual time;
more than a stage takes for one step on any platform, as that is how far it may have promised silence."""

EVENTS: Mapping[str, str] = MappingProxyType(
    {"injection": TOPICS["injection"].type, "alarm": "zenfi_msgs/msg/Alarm"}
)
"""Events beside the topics of a flight, after them within one instant, and their types."""

TYPES: Mapping[str, str] = MappingProxyType({**{topic.name: topic.type for topic in RECORDED}, **EVENTS})
"""Of everything that comes out here."""

_PLACE = {name: place for place, name in enumerate(TYPES)}


class SentMessage(NamedTuple):
    """A recorded message with the name of its topic."""

    topic: str
    message: Stamped


def in_order(sent: Iterable[SentMessage]) -> list[SentMessage]:
    """All messages by virtual time, within one instant by topic."""
    return sorted(sent, key=lambda one: (one.message.ready_ns, _PLACE[one.topic], one.message.seq))


class MessageOrder:
    """Takes from a recorder the messages that no later one can precede, in order.

    With ``held``, events may be added up to :data:`HELD_NS` after their virtual time. In ``realtime`` nobody
    promises anything: there everything is final that is a second old.
    """

    def __init__(self, recorder: FlightRecorder, *, held: bool, realtime: bool) -> None:
        self._recorder = recorder
        # A simulator that dies leaves promises of a tick more than it has flown.
        self._hold_ns = HELD_NS if held else TICK_NS
        self._realtime = realtime
        self._taken = dict.fromkeys((topic.name for topic in RECORDED), 0)
        self._events: list[SentMessage] = []
        self._counts = dict.fromkeys(EVENTS, 0)
        self._limit_ns = 0
        self.late = 0

    def tell(self, event: str, time_ns: int, payload: bytes) -> None:
        """Add an event; one that arrives too late comes out of order, and is counted."""
        self.late += time_ns < self._limit_ns
        self._events.append(SentMessage(event, Stamped(self._counts[event], time_ns, payload)))
        self._counts[event] += 1

    def take(self, end_ns: int) -> list[SentMessage]:
        """The messages that became final since the last call, of those ready up to ``end_ns``."""
        if self._realtime:
            final_ns = self._recorder.newest_ns - 1_000_000_000
        else:
            final_ns = self._recorder.horizon_ns - self._hold_ns
        limit_ns = min(final_ns, end_ns + 1)
        return self._until(limit_ns) if limit_ns >= self._limit_ns + TICK_NS else []

    def rest(self, end_ns: int) -> list[SentMessage]:
        """All messages that are left at the end of the flight."""
        return self._until(end_ns + 1)

    def _until(self, limit_ns: int) -> list[SentMessage]:
        self._limit_ns = max(limit_ns, self._limit_ns)
        found = [one for one in self._events if one.message.ready_ns < limit_ns]
        self._events = [one for one in self._events if one.message.ready_ns >= limit_ns]
        for topic, taken in self._taken.items():
            for message in self._recorder.since(topic, taken):
                if message.ready_ns >= limit_ns:
                    break
                found.append(SentMessage(topic, message))
                self._taken[topic] += 1
        return in_order(found)
