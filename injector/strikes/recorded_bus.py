"""The bus as one node saw it in a flight that was recorded: for a node that runs alone, without Zenoh.

What a node may see at a virtual time follows from the messages of the flight alone
(:mod:`services.bus.horizon`), so whoever has them can answer the node as its proxy did. What the node sends
is compared with what it had sent in the flight. As long as it is the same, no other node, nor the vehicle,
would have noticed a difference, and the answers are those of a whole flight.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

from services.bus import proxy_link
from services.bus.horizon import NEVER_NS, Stamped, next_activation
from services.bus.proxy_link import ANSWER, Frame, NonsenseError
from services.bus.session import verdict_key
from services.bus.topics import TOPICS, published_by

_TOPICS = tuple(TOPICS)

SOUND = ANSWER.pack(0, 0, 1)
"""One reply, which is empty: the detector finds nothing."""


class StrayedMessage(NamedTuple):
    """The first message that is not as in the recorded flight: its topic, number, and virtual time."""

    topic: str
    number: int
    at_ns: int


class StrayedError(Exception):
    """The node has sent something else than in the recorded flight, or has left out what it had sent."""

    def __init__(self, strayed: StrayedMessage) -> None:
        super().__init__(f"{strayed.topic} number {strayed.number} at {strayed.at_ns} ns")
        self.strayed = strayed


class EndOfRecordingError(Exception):
    """The recorded flight is over, and the node has sent what it had sent in it."""


class UnrecordedError(Exception):
    """The node asks for what no recording answers."""


@dataclass(slots=True)
class _RecordedInlet:
    """One input: its messages, how many were taken, and whether only those of earlier instants are seen.

    ``head`` and ``horizon_ns`` are those of a :class:`~services.bus.horizon.Channel` in which all has come.
    """

    messages: Sequence[Stamped]
    before_only: bool
    taken: int = 0
    horizon_ns: int = NEVER_NS

    @property
    def head(self) -> Stamped | None:
        return self.messages[self.taken] if self.taken < len(self.messages) else None

    def take(self, until_ns: int, *, inclusive: bool) -> list[Stamped]:
        begin = self.taken
        limit = until_ns + 1 if inclusive else until_ns
        while self.taken < len(self.messages) and self.messages[self.taken].ready_ns < limit:
            self.taken += 1
        return list(self.messages[begin : self.taken])


class RecordedBus:
    """Answers one node that runs from the beginning of a flight, and compares what it sends.

    ``messages`` are the flight's, by topic, all that were ready up to ``end_ns``.
    """

    def __init__(self, node: str, messages: Mapping[str, Sequence[Stamped]], end_ns: int) -> None:
        self._node = node
        self._messages = messages
        self._end_ns = end_ns
        self._inlets: list[_RecordedInlet] = []
        self._sent = {topic.name: 0 for topic in published_by(node)}
        self._asked = 0
        self._learning = False
        self.questions: list[bytes] = []
        """What the node had asked the detector in the flight, all of which was found sound."""
        self.now_ns = 0

    def copy(self) -> Self:
        """The bus as it is now, for a copy of the node."""
        twin = copy(self)
        twin._inlets = [replace(one) for one in self._inlets]
        twin._sent = dict(self._sent)
        return twin

    def learning(self) -> Self:
        """The bus as it is now, for a copy that nothing strikes: it learns what is asked of the detector."""
        twin = self.copy()
        twin._learning = True
        return twin

    def take(self, frame: Frame) -> bytes | None:
        """Take in what the node says; the answer, if it waits for one.

        :raises StrayedError: if it has sent something else than in the flight.
        :raises EndOfRecordingError: if nothing follows in the flight.
        :raises UnrecordedError: if it asks for something that is not in a recording.
        """
        kind, place, first, _, payload = frame
        if kind == proxy_link.PUT:
            if place >= len(_TOPICS) or _TOPICS[place] not in self._sent:
                raise NonsenseError(f"{self._node} publishes topic number {place}")
            self._compare(_TOPICS[place], first, payload)
            return None
        if kind == proxy_link.PROMISE:
            return None
        if kind == proxy_link.READY:
            self._declare(json.loads(payload)["inputs"])
            return ANSWER.pack(0, 0, 0)
        if kind == proxy_link.NEXT:
            return self._next(place, first)
        if kind == proxy_link.ASK and payload.startswith(verdict_key(self._node).encode() + b"\0"):
            return self._judge(payload.partition(b"\0")[2])
        message = f"{self._node} sends a frame of kind {kind}, which no recording answers"
        raise UnrecordedError(message)

    def _judge(self, question: bytes) -> bytes:
        """The detector's answer, which depends on nothing but what it was asked."""
        number, self._asked = self._asked, self._asked + 1
        if self._learning:
            self.questions.append(question)
        elif number >= len(self.questions) or question != self.questions[number]:
            raise UnrecordedError("it asks the detector of another output than in the flight")
        return SOUND

    def _declare(self, inputs: Sequence[str]) -> None:
        rank = published_by(self._node)[0].rank
        self._inlets = [_RecordedInlet(self._messages[name], TOPICS[name].rank >= rank) for name in inputs]

    def _compare(self, topic: str, ready_ns: int, payload: bytes) -> None:
        number, recorded = self._sent[topic], self._messages[topic]
        self._sent[topic] += 1
        if number < len(recorded):
            same = (recorded[number].ready_ns, recorded[number].payload) == (ready_ns, payload)
        else:
            same = ready_ns > self._end_ns  # what the flight did not last for was not recorded
        if not same:
            at_ns = min(ready_ns, recorded[number].ready_ns) if number < len(recorded) else ready_ns
            raise StrayedError(StrayedMessage(topic, number, at_ns))

    def _next(self, place: int, busy_until_ns: int) -> bytes:
        if place >= len(self._inlets):
            raise NonsenseError(f"{self._node} has no input number {place}")
        trigger = self._inlets[place]
        start = next_activation(trigger, busy_until_ns)
        if start is None or start > self._end_ns:
            self._require_all_sent()
            raise EndOfRecordingError
        self.now_ns = start
        queued = trigger.take(start, inclusive=True)
        seen = [
            (number, message)
            for number, one in enumerate(self._inlets)
            for message in (queued[-1:] if one is trigger else one.take(start, inclusive=not one.before_only))
        ]
        body = proxy_link.pack(seen)
        return ANSWER.pack(len(body), len(queued) - 1, start) + body

    def _require_all_sent(self) -> None:
        for topic, sent in self._sent.items():
            if sent < len(self._messages[topic]):
                raise StrayedError(StrayedMessage(topic, sent, self._messages[topic][sent].ready_ns))
