"""Lockstep without a global barrier: conservative look-ahead over streams of stamped messages.

Every message carries the virtual time at which it is *ready*; every publisher promises, for each of
its topics, a *horizon*: "I have published `count` messages, and none that follows is ready before
`until`". A stage may act at virtual time t as soon as the horizons of its inputs have passed t,
however the wall clock and the scheduler behave. (Chandy and Misra 1979, with null messages.)

Nothing here knows Zenoh: messages go in as they arrive, late, doubled or out of order, and come out
by virtual time.
"""

from __future__ import annotations

import functools
import struct
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple, Protocol, Self

NEVER_NS = 2**62
"""Later than everything: the horizon of a topic on which no message follows."""


@dataclass(frozen=True, slots=True)
class Stamped:
    """A message as it travels: position in its topic, virtual time at which it is ready, CDR bytes."""

    seq: int
    ready_ns: int
    payload: bytes


class Promise(NamedTuple):
    """What a stage says of its own future silence: thousands in a flight, so they have no ROS type.

    ``published`` messages of each of its topics are out, and none that follows is ready before
    ``until_ns``, in the order of the table. ``accepted_ns`` is the newest trigger that it has dealt with,
    ``busy_until_ns`` the time before which it takes up no other. Of two promises the one with the higher
    ``serial`` is the newer; its upper half counts the starts of the node.
    """

    serial: int
    accepted_ns: int
    busy_until_ns: int
    until_ns: tuple[int, ...]
    published: tuple[int, ...]

    def packed(self) -> bytes:
        """The promise as the bytes that are sent."""
        numbers = (self.serial, self.accepted_ns, self.busy_until_ns, *self.until_ns, *self.published)
        return _promise_of(len(self.published)).pack(*numbers)

    @classmethod
    def unpacked(cls, raw: bytes, topics: int) -> Self:
        """The promise on so many topics in such bytes.

        :raises ValueError: if they are too few or too many.
        """
        form = _promise_of(topics)
        if len(raw) != form.size:
            message = f"a promise on {topics} topics has {form.size} bytes, not {len(raw)}"
            raise ValueError(message)
        serial, accepted_ns, busy_until_ns, *rest = form.unpack(raw)
        return cls(serial, accepted_ns, busy_until_ns, tuple(rest[:topics]), tuple(rest[topics:]))


@functools.cache
def _promise_of(topics: int) -> struct.Struct:
    return struct.Struct(f"<{3 + 2 * topics}q")


class Channel:
    """One input topic of one stage: reorders by sequence number and holds back the future.

    A stage that was restarted begins at ``first_seq`` and ignores what was ready before it was there.
    """

    def __init__(self, first_seq: int = 0, ignore_before_ns: int = 0) -> None:
        self._next_seq = first_seq
        self._ignore_before_ns = ignore_before_ns
        self._early: dict[int, Stamped] = {}
        self._queue: deque[Stamped] = deque()
        self._promises: deque[tuple[int, int]] = deque()
        self._horizon_ns = 0
        self.duplicates = 0

    def receive(self, message: Stamped) -> None:
        """Take in a message, in whatever order the bus delivers."""
        if message.seq < self._next_seq or message.seq in self._early:
            self.duplicates += 1
            return
        self._early[message.seq] = message
        while (successor := self._early.pop(self._next_seq, None)) is not None:
            self._next_seq += 1
            if successor.ready_ns >= self._ignore_before_ns:
                self._queue.append(successor)
        self._settle()

    def promise(self, count: int, until_ns: int) -> None:
        """Take in a promise; it holds once all ``count`` messages that it speaks of are here."""
        self._promises.append((count, until_ns))
        self._settle()

    def _settle(self) -> None:
        while self._promises and self._promises[0][0] <= self._next_seq:
            self._horizon_ns = max(self._horizon_ns, self._promises.popleft()[1])

    @property
    def horizon_ns(self) -> int:
        """No message that is not yet here is ready before this time."""
        return self._horizon_ns

    @property
    def next_seq(self) -> int:
        """Sequence number of the first message that is missing."""
        return self._next_seq

    @property
    def head(self) -> Stamped | None:
        """The oldest message not yet taken."""
        return self._queue[0] if self._queue else None

    def take(self, until_ns: int, *, inclusive: bool) -> list[Stamped]:
        """Remove and return the messages that are ready before ``until_ns`` (or just then)."""
        limit = until_ns + 1 if inclusive else until_ns
        taken = []
        while self._queue and self._queue[0].ready_ns < limit:
            taken.append(self._queue.popleft())
        return taken


class TriggeringInput(Protocol):
    """What a stage is triggered by: the oldest message not taken, and until when no other can come."""

    @property
    def head(self) -> Stamped | None:
        """The oldest message not yet taken."""

    @property
    def horizon_ns(self) -> int:
        """No message that is not yet here is ready before this time."""


def next_activation(trigger: TriggeringInput, busy_until_ns: int) -> int | None:
    """When a stage that is busy until then takes up its next trigger; None while that is open.

    A free stage starts at the first trigger. One that was busy starts as soon as it is free with the
    newest trigger that came meanwhile (a queue of length one, as in ROS), so it must know that no
    newer one can still come.
    """
    head = trigger.head
    if head is None:
        return None
    if head.ready_ns >= busy_until_ns:
        return head.ready_ns
    return busy_until_ns if trigger.horizon_ns > busy_until_ns else None


def earliest_activation(trigger: Channel, busy_until_ns: int) -> int:
    """A time before which the next trigger is certainly not taken up: the basis of every promise."""
    start = trigger.head.ready_ns if trigger.head is not None else trigger.horizon_ns
    return max(busy_until_ns, start)
