"""What happened lately, kept once for all who watch.

A watcher holds nothing but a number: how far it has read. So one that is slow, or never reads, costs no
memory and nobody any time; what it comes too late for is counted and told to it.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import OrderedDict, deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Literal

KEPT = 4096
"""Events that a client may be behind: more than a quarter of an hour of two flights' poses."""

KEYS_KEPT = 512
"""Campaigns, flights and processes whose newest event is kept for late clients."""

Kind = Literal["campaign", "run", "flight", "process", "lost"]


@dataclass(frozen=True, slots=True)
class BusEvent:
    """``data`` is JSON. ``key`` names what it tells of: a later event of the same key supersedes it."""

    number: int
    kind: Kind
    data: str
    campaign: str = ""
    key: str = ""


class EventBus:
    """Takes events in from any thread, gives them out on one event loop.

    The identity of an event is ``LIFE.NUMBER``: numbers begin anew with each life of the service.
    """

    def __init__(self, kept: int = KEPT) -> None:
        self.life = f"{time.time_ns():x}"
        self.dropped = 0
        self.watchers = 0
        self._lock = threading.Lock()
        self._events: deque[BusEvent] = deque(maxlen=kept)
        self._newest: OrderedDict[str, BusEvent] = OrderedDict()
        self._last = 0
        self._closed = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._news = asyncio.Event()

    @property
    def last(self) -> int:
        """The number of the newest event, 0 before the first."""
        return self._last

    @property
    def closed(self) -> bool:
        """Whether there will be no more."""
        return self._closed

    def identity(self, number: int) -> str:
        """What a client tells when it comes back."""
        return f"{self.life}.{number}"

    def bind(self, loop: asyncio.AbstractEventLoop) -> None:
        """Set the event loop on which watchers are woken."""
        self._loop = loop

    def publish(self, kind: Kind, data: str, campaign: str = "", key: str = "") -> None:
        """Take in an event; costs the same however many watch."""
        with self._lock:
            self._last += 1
            event = BusEvent(self._last, kind, data, campaign, key)
            self._events.append(event)
            if key:
                self._newest[key] = event
                self._newest.move_to_end(key)
                if len(self._newest) > KEYS_KEPT:
                    self._newest.popitem(last=False)
        self._wake()

    def forget(self, key: str) -> None:
        """What a key names is over: late clients need not hear of it."""
        with self._lock:
            self._newest.pop(key, None)

    def close(self) -> None:
        """End every stream once it has told what there is."""
        self._closed = True
        self._wake()

    def newest(self, campaign: str = "") -> list[BusEvent]:
        """The newest event of everything that goes on (in one campaign), in order."""
        with self._lock:
            events = sorted(self._newest.values(), key=lambda event: event.number)
        return [event for event in events if campaign in ("", event.campaign)]

    def place(self, identity: str | None) -> int | None:
        """Where a client that saw the event ``identity`` goes on; None if that was in another life."""
        life, _, number = (identity or "").rpartition(".")
        if life != self.life or not number.isdecimal() or len(number) > 18:
            return None
        return min(int(number), self._last)

    async def follow(self, after: int, campaign: str = "") -> AsyncIterator[BusEvent]:
        """Events with numbers above ``after``; one of kind ``lost`` counts those that are gone."""
        self.watchers += 1
        try:
            while True:
                news = self._news
                closed = self._closed
                missed, events = self._since(after)
                if missed:
                    self.dropped += missed
                    yield BusEvent(after + missed, "lost", f'{{"events": {missed}}}')
                for event in events:
                    if campaign in ("", event.campaign):
                        yield event
                    after = event.number
                if not events:
                    if closed:
                        return
                    await news.wait()
        finally:
            self.watchers -= 1

    def _since(self, after: int, most: int = 64) -> tuple[int, list[BusEvent]]:
        with self._lock:
            first = self._last - len(self._events) + 1
            missed = max(first - after - 1, 0)
            begin = after + missed + 1 - first
            return missed, [self._events[i] for i in range(begin, min(begin + most, len(self._events)))]

    def _wake(self) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._ring)

    def _ring(self) -> None:
        news, self._news = self._news, asyncio.Event()
        news.set()
