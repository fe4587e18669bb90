"""The recorder: keeps every message of a mission, answers for lost ones, and digests the flight."""

from __future__ import annotations

import bisect
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from services.bus.horizon import NEVER_NS, Channel, Stamped
from services.bus.messages import MalformedMessageError
from services.bus.ports import promise_of
from services.bus.topics import RECORDED, STAGES, published_by
from services.models.outcome import TopicReport

DIGEST_BYTES = 16


@dataclass
class FlightTrace:
    """A flight as its messages: by topic, the ready time and digest of each, in order of sequence."""

    times_ns: dict[str, list[int]] = field(default_factory=dict)
    digests: dict[str, list[bytes]] = field(default_factory=dict)

    @classmethod
    def of(cls, messages: Mapping[str, Sequence[Stamped]]) -> FlightTrace:
        """The trace of a flight's messages by topic."""
        return cls(
            {topic: [message.ready_ns for message in kept] for topic, kept in messages.items()},
            {topic: [_digest(message) for message in kept] for topic, kept in messages.items()},
        )

    def report(self, topic: str, twin: FlightTrace | None) -> TopicReport:
        """The topic's digest, and when its messages left those of the golden ``twin``."""
        digests = self.digests[topic]
        left = self.divergence(topic, twin) if twin is not None else None
        return TopicReport(
            messages=len(digests),
            digest=hashlib.blake2b(b"".join(digests), digest_size=DIGEST_BYTES).hexdigest(),
            diverged_at_s=None if left is None else left.at_ns / 1e9,
        )

    def divergence(self, topic: str, twin: FlightTrace) -> Divergence | None:
        """The first message of a topic that differs from, or is missing in, one of the two flights."""
        times, digests = self.times_ns[topic], self.digests[topic]
        twin_times, twin_digests = twin.times_ns[topic], twin.digests[topic]
        pairs = zip(digests, twin_digests, strict=False)
        for number, (digest, twin_digest) in enumerate(pairs):
            if digest != twin_digest:
                return Divergence(number, min(times[number], twin_times[number]))
        shorter = min(len(digests), len(twin_digests))
        rest = times[shorter:] or twin_times[shorter:]
        return Divergence(shorter, rest[0]) if rest else None

    def digest(self) -> str:
        """The digest over every recorded message of the flight."""
        whole = hashlib.blake2b(digest_size=DIGEST_BYTES)
        for topic, digests in self.digests.items():
            if not digests:
                continue  # a topic that the mission has no use for
            whole.update(topic.encode())
            whole.update(b"".join(digests))
        return whole.hexdigest()


class Divergence(NamedTuple):
    """Where a topic left its twin's: number of the message, virtual time of the earlier of the two."""

    message: int
    at_ns: int


class FlightRecorder:
    """Takes in what arrives from the bus; nothing here knows Zenoh."""

    def __init__(self) -> None:
        self._channels = {topic.name: Channel() for topic in RECORDED}
        self._history: dict[str, list[Stamped]] = {topic.name: [] for topic in RECORDED}
        self._horizons: dict[str, bytes] = {}
        self._serials: dict[str, int] = dict.fromkeys(STAGES, -1)
        self.malformed = 0

    def record(self, topic: str, message: Stamped) -> None:
        """Take in a message of a recorded topic."""
        channel = self._channels[topic]
        channel.receive(message)
        self._history[topic].extend(channel.take(NEVER_NS, inclusive=True))

    @property
    def refused(self) -> int:
        """How many messages and promises could not be kept: malformed, or of an old sequence number."""
        return self.malformed + sum(channel.duplicates for channel in self._channels.values())

    def hear(self, stage: str, payload: bytes) -> None:
        """Take in a promise that a stage has published."""
        try:
            message = promise_of(stage, payload)
        except MalformedMessageError:
            self.malformed += 1
            return
        if message.serial > self._serials[stage]:
            self._serials[stage] = int(message.serial)
            self._horizons[stage] = payload
        for topic, count, until_ns in zip(
            published_by(stage), message.published, message.until_ns, strict=True
        ):
            self._channels[topic.name].promise(int(count), int(until_ns))

    def since(self, topic: str, seq: int) -> list[Stamped]:
        """The messages of a topic from sequence number ``seq`` on."""
        return self._history[topic][seq:]

    def horizon(self, stage: str) -> bytes | None:
        """The newest promise of a stage as it was published, None before the first."""
        return self._horizons.get(stage)

    def last(self, topic: str) -> Stamped | None:
        """The newest message of a topic."""
        history = self._history[topic]
        return history[-1] if history else None

    def published(self, stage: str) -> dict[str, int]:
        """How many messages of each of a stage's topics are recorded."""
        return {topic.name: len(self._history[topic.name]) for topic in published_by(stage)}

    def silent_until_ns(self, stage: str) -> int:
        """The end of what a stage has promised or published: where its next process can begin."""
        ends = [self._channels[topic.name].horizon_ns for topic in published_by(stage)]
        ends += [last.ready_ns for topic in published_by(stage) if (last := self.last(topic.name))]
        return max(ends)

    def resume_from(self, time_ns: int) -> dict[str, int]:
        """Where a node that begins at ``time_ns`` takes up each topic: latched ones one message earlier."""
        start = {}
        for topic in RECORDED:
            history = self._history[topic.name]
            first = bisect.bisect_left(history, time_ns, key=lambda message: message.ready_ns)
            start[topic.name] = max(first - 1, 0) if topic.qos == "latched" else first
        return start

    @property
    def horizon_ns(self) -> int:
        """No message that is not yet recorded is ready before this time."""
        return min(channel.horizon_ns for channel in self._channels.values())

    @property
    def newest_ns(self) -> int:
        """When the newest odometry was ready; 0 before the first."""
        last = self.last("odometry")
        return last.ready_ns if last is not None else 0

    def complete(self, end_ns: int) -> bool:
        """Whether everything up to and including ``end_ns`` is recorded."""
        return all(channel.horizon_ns > end_ns for channel in self._channels.values())

    def until(self, end_ns: int) -> dict[str, list[Stamped]]:
        """The messages that were ready up to and including ``end_ns``, by topic."""
        return {
            topic: [message for message in history if message.ready_ns <= end_ns]
            for topic, history in self._history.items()
        }

    def trace(self, end_ns: int) -> FlightTrace:
        """Times and digests of what was ready up to and including ``end_ns``."""
        return FlightTrace.of(self.until(end_ns))


def _digest(message: Stamped) -> bytes:
    stamp = message.ready_ns.to_bytes(8, "little", signed=True)
    return hashlib.blake2b(stamp + message.payload, digest_size=DIGEST_BYTES).digest()
