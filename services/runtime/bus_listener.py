"""What a node's proxy takes in from the bus: messages, promises, announcements, replies, its node's end."""

from __future__ import annotations

import os
import queue
import signal
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import zenoh
from zenoh.handlers import Callback

from services.bus import announce, session
from services.bus.messages import MalformedMessageError
from services.bus.ports import Inlet, promise_of
from services.bus.topics import CARRIERS, published_by

PATIENCE_S = 0.05
"""Wall time without any message after which a waiting proxy asks the recorder for what it missed."""


class NodeGoneError(Exception):
    """The node has ended while it waited for an answer."""


class BusListener:
    """The subscriptions of one node, with a queue that its proxy's only thread handles while it waits.

    ``inlets`` are the node's inputs by topic in the order of their declaration, ``promises`` the newest
    promise of each followed stage, None before the first.
    """

    def __init__(self, bus: zenoh.Session, node_pid: int, page: np.void) -> None:
        self.inlets: dict[str, Inlet] = {}
        self.promises: dict[str, Any] = {}
        self.announced: set[str] = set()
        self._bus = bus
        self._node_pid = node_pid
        self._page = page
        self._inbox: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._declared: list[Any] = []
        self._replies: list[bytes] = []
        self._asking = False

    def notice_end_of_node(self) -> None:
        """Have :meth:`wait` raise once the node has ended; it may be dead already."""
        signal.signal(signal.SIGCHLD, lambda *_: self._inbox.put(("child", None)))
        self._inbox.put(("child", None))

    def subscribe(self, name: str, inlet: Inlet) -> None:
        """Take in the messages of a topic."""
        self.inlets[name] = inlet
        self._subscribe(session.topic_key(name), name)

    def follow(self, stage: str) -> None:
        """Take in the promises of a stage."""
        self.promises[stage] = None
        self._subscribe(session.horizon_key(stage), f"horizon/{stage}")
        carrier = CARRIERS.get(stage)
        if carrier is not None and carrier not in self.inlets:
            self._subscribe(session.topic_key(carrier), f"carrier/{stage}")

    def announce(self, key: str, expected: set[str]) -> None:
        """Announce the node, and wait until all ``expected`` nodes are announced."""
        liveliness = self._bus.liveliness()
        self._declared.append(liveliness.declare_token(key))
        with liveliness.declare_subscriber(announce.ALL, self._handler("announced"), history=True):
            self.wait(lambda: expected <= self.announced, when_idle=lambda: None)

    def ask(self, key: str, payload: bytes, timeout_s: float) -> list[bytes]:
        """Ask whoever answers for ``key``; their replies, none if nobody does in time."""
        inbox = self._inbox
        self._replies.clear()
        self._asking = True
        replied: Callback[zenoh.Reply] = Callback(
            lambda reply: inbox.put(("reply", reply)),
            lambda: inbox.put(("answered", None)),
            indirect=False,
        )
        self._bus.get(key, replied, payload=payload, timeout=timeout_s)
        self.wait(lambda: not self._asking, when_idle=lambda: None)
        return self._replies

    def wait(self, done: Callable[[], bool], when_idle: Callable[[], None] | None = None) -> None:
        """Take in what comes until ``done``; ask the recorder, or call ``when_idle``, when nothing does.

        :raises NodeGoneError: if the node has ended.
        """
        patience = PATIENCE_S
        while not done():
            if self.take_in(patience):
                continue
            (when_idle or self._recover)()
            patience = min(2 * patience, 1.0)

    def take_in(self, timeout_s: float) -> bool:
        """Handle what has arrived; wait for it up to ``timeout_s``. False if nothing came.

        :raises NodeGoneError: if the node has ended.
        """
        try:
            self._handle(*self._inbox.get(timeout=timeout_s))
        except queue.Empty:
            return False
        self.take_in_arrived()
        return True

    def take_in_arrived(self) -> None:
        """Handle what has arrived already.

        :raises NodeGoneError: if the node has ended.
        """
        while not self._inbox.empty():
            self._handle(*self._inbox.get())

    def history(self, name: str, payload: str = "") -> Iterator[zenoh.Sample]:
        """Fetch from the recorder what it has of a topic, or of the promises ``horizon/STAGE``."""
        replies = self._bus.get(
            f"{session.HISTORY_KEY}/{name}",
            payload=payload,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=10.0,
        )
        for reply in replies:
            if reply.ok is not None:
                yield reply.ok

    def _subscribe(self, key: str, label: str) -> None:
        self._declared.append(self._bus.declare_subscriber(key, self._handler(label)))

    def _handler(self, label: str) -> Callback[Any]:
        inbox = self._inbox
        return session.hand_over(lambda sample: inbox.put((label, sample)))

    def _handle(self, label: str, arrived: Any) -> None:
        kind, _, stage = label.partition("/")
        if kind == "horizon":
            self._take_promise(stage, arrived.payload.to_bytes())
        elif kind == "carrier":
            self._take_carried(stage, arrived)
        elif kind == "child":
            if os.waitid(os.P_PID, self._node_pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
                raise NodeGoneError
        elif kind == "announced":
            self.announced.add(announce.Announcement.parse(str(arrived.key_expr)).name)
        elif kind == "reply":
            if arrived.ok is not None:
                self._replies.append(arrived.ok.payload.to_bytes())
        elif kind == "answered":
            self._asking = False
        else:
            self._take_message(self.inlets[label], arrived)

    def _take_message(self, inlet: Inlet, sample: zenoh.Sample) -> None:
        channel, page = inlet.channel, self._page
        doubled = channel.duplicates
        try:
            message, promise = session.stamped(sample)
            channel.receive(message)
            if promise:
                self._take_promise(inlet.topic.publisher, promise)
        except MalformedMessageError:
            page["unreadable"] += 1
        if channel.duplicates == doubled:
            return
        # What comes again after the recorder's answer was not lost, only slower.
        if page["recovered"] > 0:
            page["recovered"] -= 1
        else:
            page["doubled"] += 1

    def _take_carried(self, stage: str, sample: zenoh.Sample) -> None:
        """Take the promise that a message carries which the node has no use for."""
        try:
            _, promise = session.stamped(sample)
        except MalformedMessageError:
            self._page["unreadable"] += 1
            return
        if promise:
            self._take_promise(stage, promise)

    def _take_promise(self, stage: str, payload: bytes) -> None:
        try:
            message = promise_of(stage, payload)
        except MalformedMessageError:
            self._page["unreadable"] += 1
            return
        newest = self.promises[stage]
        if newest is None or message.serial > newest.serial:
            self.promises[stage] = message
        of_topics = zip(published_by(stage), message.published, message.until_ns, strict=True)
        for topic, published, until_ns in of_topics:
            if topic.name in self.inlets:
                self.inlets[topic.name].channel.promise(published, until_ns)

    def _recover(self) -> None:
        """Fetch from the recorder what was published before our subscription was known."""
        for name, inlet in self.inlets.items():
            known = inlet.channel.next_seq
            for sample in self.history(name, str(known)):
                inlet.channel.receive(session.stamped(sample)[0])
            self._page["recovered"] += inlet.channel.next_seq - known
        for stage in self.promises:
            for sample in self.history(f"horizon/{stage}"):
                self._take_promise(stage, sample.payload.to_bytes())
