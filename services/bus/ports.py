"""Inputs and outputs of a node: topics as its stage sees them, and as its proxy does."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import zenoh

from services.bus import session
from services.bus.horizon import Channel, Promise, Stamped
from services.bus.message_checks import AddedChecks, Checks, refuse_by_added
from services.bus.messages import MalformedMessageError, decode
from services.bus.topics import Topic, published_by


def promise_of(stage: str, payload: bytes) -> Promise:
    """Parse a message that holds the promise of a stage.

    :raises MalformedMessageError: if it does not speak of the stage's topics.
    """
    try:
        return Promise.unpacked(payload, len(published_by(stage)))
    except ValueError as error:
        message = f"{stage}: {error}"
        raise MalformedMessageError(message) from error


RECENT = 64
"""Messages that an input remembers for :meth:`Input.at`."""


Parse = Callable[[Any, Checks], Any]
"""Makes of a decoded message what a stage works with.

Raises :class:`MalformedMessageError` if it makes no sense, by those checks that are switched on.
"""


def as_it_is(message: Any, _: Checks) -> Any:
    """Return the message unchanged: the default parser of an input."""
    return message


class Input:
    """A subscribed topic as the stage sees it; ``refused`` is called for each message that is refused."""

    def __init__(
        self,
        topic: Topic,
        parse: Parse,
        checks: Checks,
        refused: Callable[[MalformedMessageError], None],
        added: AddedChecks,
    ) -> None:
        self.topic = topic
        self._added = added
        self.new: list[Stamped] = []
        self._parse = parse
        self._checks = checks
        self._refused = refused
        self._recent: deque[Stamped] = deque(maxlen=RECENT)
        self._latest: Any = None

    def deliver(self, messages: list[Stamped]) -> None:
        """Make the messages visible that have become ready."""
        self.new = messages
        if messages:
            self._recent.extend(messages)
            self._latest = None

    def read(self, message: Stamped) -> Any | None:
        """The parsed message; None (and counted) if it is malformed."""
        try:
            decoded = decode(message.payload, self.topic.type)
            parsed = self._parse(decoded, self._checks)
            refuse_by_added(self._added, self.topic.name, decoded)
        except MalformedMessageError as error:
            self._refused(error)
            return None
        return parsed

    @property
    def latest(self) -> Any | None:
        """The newest well-formed message, None before the first."""
        while self._latest is None and self._recent:
            self._latest = self.read(self._recent[-1])
            if self._latest is None:
                self._recent.pop()
        return self._latest

    def at(self, ready_ns: int) -> Any | None:
        """The message that became ready at exactly this time, if it is among the recent ones."""
        for message in reversed(self._recent):
            if message.ready_ns == ready_ns:
                return self.read(message)
        return None


class Inlet:
    """A subscribed topic as it comes from the bus."""

    def __init__(self, topic: Topic, stage_rank: int, first_seq: int, start_ns: int) -> None:
        self.topic = topic
        self.channel = Channel(first_seq, start_ns if topic.qos == "stream" else 0)
        self.before_only = topic.rank >= stage_rank

    def complete(self, now_ns: int) -> bool:
        """Whether everything that the stage may see at ``now_ns`` is here."""
        horizon = self.channel.horizon_ns
        return horizon >= now_ns if self.before_only else horizon > now_ns

    def take(self, now_ns: int) -> list[Stamped]:
        """Remove and return what the stage may see at ``now_ns``."""
        return self.channel.take(now_ns, inclusive=not self.before_only)


class Outlet:
    """A published topic: numbers, stamps and sends messages."""

    def __init__(
        self, on: zenoh.Session, owner: str, topic: Topic, lookahead_ns: int, published: int
    ) -> None:
        """Declare the publisher of ``topic``, whose next message has the number ``published``."""
        self.lookahead_ns = lookahead_ns
        self.published = published
        self._gid = session.publisher_gid(owner, topic.name)
        self._publisher = session.declare_publisher(
            on, session.topic_key(topic.name), zenoh.Encoding.APPLICATION_CDR
        )

    def put(self, payload: bytes, ready_ns: int, promise: bytes = b"") -> None:
        """Publish a message as ready at ``ready_ns``; it carries the ``promise`` that follows it."""
        self._publisher.put(payload, attachment=session.attach(self.published, ready_ns, self._gid, promise))
        self.published += 1
