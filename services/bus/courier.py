"""The courier: a small process beside each node that has the node's part in the bus.

It sends what the node publishes, takes in what the node may see once that is settled, passes on how long
the node will be silent, and announces the node's process. What depends on when messages come stays here.
It outlives its node until all that the node said is delivered; the node does not outlive it.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import time
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import zenoh
from zenoh.handlers import Callback

from services.bus import announce, line, session
from services.bus.horizon import NEVER_NS, Stamped, earliest_activation, next_activation
from services.bus.latency import Latency
from services.bus.line import CourierLine, Frame
from services.bus.messages import Horizon, MalformedMessageError, decode, encode
from services.bus.node import NodeSetup
from services.bus.ports import Inlet, Outlet, promise_of
from services.bus.process_stat import listed_pid, process_stat
from services.bus.topics import HORIZON_TYPE, STAGES, TOPICS, published_by
from services.bus.vitals import Vitals

PATIENCE_S = 0.05
"""Wall time without any message after which a waiting courier asks the recorder for what it missed."""

LINKING_S = 0.2
"""Longest wait for links to all other nodes; one may be dead."""

FLUSH_S = 10.0
LIFE_SHIFT = 32
_TOPICS = tuple(TOPICS)


class NodeGoneError(Exception):
    """The node has ended while it waited for an answer."""


class Courier:
    """The bus as one node sees it. To be used by a process with no other thread of its own."""

    def __init__(
        self, setup: NodeSetup, meeting: session.Meeting, node: CourierLine, node_pid: int, vitals: Vitals
    ) -> None:
        self.name = setup.name
        self._setup = setup
        self._node = node
        self._node_pid = node_pid
        self._page = vitals.page
        self._inbox: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._inlets: dict[str, Inlet] = {}
        self._declared: list[Any] = []
        self._heard: dict[str, Any] = {}
        self._present: set[str] = set()
        self._replies: list[bytes] = []
        self._asking = False
        self._accepted_ns = self._handed_ns = setup.start_ns - 1
        self._serial = setup.life << LIFE_SHIFT
        self._promised: tuple[int, ...] = ()
        self.session = session.open_session(meeting, self.name)
        topics = published_by(self.name)
        self._rank = topics[0].rank
        self._outlets = {
            topic.name: Outlet(
                self.session,
                self.name,
                topic,
                self._lookahead_ns(setup.spec.kernels_before(topic)),
                setup.published.get(topic.name, 0),
            )
            for topic in topics
        }
        self._horizon = self.session.declare_publisher(
            session.horizon_key(self.name), congestion_control=zenoh.CongestionControl.BLOCK
        )

    def _lookahead_ns(self, kernels: tuple[str, ...]) -> int:
        seed, stated, life = self._setup.spec.seed, self._setup.latencies, self._setup.life
        return sum(Latency(stated[name], seed, name, life).least_ns for name in kernels)

    # -- serving the node --------------------------------------------------------------------------

    def serve(self) -> None:
        """Do what the node says, until it hangs up or dies, and see to it that all has arrived.

        :raises NonsenseError: if it says what no node says.
        :raises BusError: if the bus fails us.
        """
        signal.signal(signal.SIGCHLD, lambda *_: self._inbox.put(("child", None)))
        self._inbox.put(("child", None))  # it may be dead already
        try:
            while (frame := self._node.hear()) is not None:
                try:
                    self._do(frame)
                except NodeGoneError:
                    continue  # what it had said before is still in the line
        finally:
            self._flush()
            self.session.close()  # type: ignore[no-untyped-call]

    def _do(self, frame: Frame) -> None:
        kind, place, first, second, payload = frame
        if kind == line.PUT:
            self._put(self._known(_TOPICS, place, (*self._outlets, "injection")), payload, first)
        elif kind == line.PROMISE:
            self.promise(first, second)
        elif kind == line.NEXT:
            self._next(self._known(tuple(self._inlets), place, self._inlets), first)
        elif kind == line.ADVANCE:
            self._advance(first)
        elif kind == line.BUSY_UNTIL:
            self._node.answer(self._busy_until(self._known(STAGES, place, self._heard), first))
        elif kind == line.ASK:
            self._ask(payload, first / 1e9)
        elif kind == line.READY:
            self._ready(**json.loads(payload))

    def _known(self, names: Sequence[str], place: int, own: Container[str]) -> str:
        """The name at a place, if it is one of our own: a node that was struck may say anything."""
        if place < len(names) and names[place] in own:
            return names[place]
        message = f"{self.name} speaks of number {place} of {', '.join(names)}"
        raise line.NonsenseError(message)

    # -- getting ready -----------------------------------------------------------------------------

    def _ready(self, inputs: list[str], watched: list[str], program: int | None = None) -> None:
        """Announce the node, or the ``program`` that computes for it, and wait until every node is announced.

        A node that is announced before gossip has linked it to the others would miss their first
        messages and have to fetch them; so it waits a little, though nothing depends on it.
        """
        for name in inputs:
            topic = TOPICS[name]
            first_seq = self._setup.resume_from.get(name, 0)
            self._inlets[name] = Inlet(topic, self._rank, first_seq, self._setup.start_ns)
            self._subscribe(session.topic_key(name), name)
        for stage in dict.fromkeys([*(TOPICS[name].publisher for name in inputs), *watched]):
            self._heard[stage] = None
            self._subscribe(session.horizon_key(stage), f"horizon/{stage}")
        others = len(self._setup.expected) - 1
        deadline = time.monotonic() + LINKING_S
        while len(self.session.info.peers_zid()) < others and time.monotonic() < deadline:
            time.sleep(0.0005)
        own = announce.announcement(self.name, self._computing(program))
        liveliness = self.session.liveliness()
        self._declared.append(liveliness.declare_token(own.key))
        missing = set(self._setup.expected) - {self.name}
        with liveliness.declare_subscriber(announce.ALL, self._handler("present"), history=True):
            self._wait(lambda: missing <= self._present, at_a_loss=lambda: None)
        self._node.answer(0)

    def _computing(self, program: int | None) -> int:
        """Who computes: the node, or a child of it; of nobody else is a pid announced."""
        node = listed_pid(self._node_pid)
        if program is None:
            return node
        try:
            parent = process_stat(program).parent
        except OSError:
            raise NodeGoneError from None  # it died before it was announced, and its node with it
        if parent != node:
            message = f"{self.name} speaks of process {program}, which is none of its own"
            raise line.NonsenseError(message)
        return program

    def _subscribe(self, key: str, label: str) -> None:
        self._declared.append(self.session.declare_subscriber(key, self._handler(label)))

    def _handler(self, label: str) -> Callback[Any]:
        inbox = self._inbox
        return session.hand_over(lambda sample: inbox.put((label, sample)))

    # -- publishing --------------------------------------------------------------------------------

    def _put(self, topic: str, payload: bytes, ready_ns: int) -> None:
        if topic == "injection":
            self.session.put(session.topic_key(topic), payload)
            return
        self._outlets[topic].put(payload, ready_ns)

    def promise(self, base_ns: int, busy_until_ns: int) -> None:
        """Tell the followers that nothing more is triggered before ``base_ns``."""
        until = [min(base_ns + outlet.lookahead_ns, NEVER_NS) for outlet in self._outlets.values()]
        promised = (self._accepted_ns, busy_until_ns, *until)
        if promised != self._promised:
            self._promised = promised
            self._send_promise()

    def _send_promise(self) -> None:
        accepted_ns, busy_until_ns, *until = self._promised
        self._serial += 1
        message = Horizon(
            serial=self._serial,
            accepted_ns=accepted_ns,
            busy_until_ns=busy_until_ns,
            until_ns=np.array(until, dtype=np.int64),
            count=np.array([outlet.published for outlet in self._outlets.values()], dtype=np.uint64),
        )
        self._horizon.put(encode(message, HORIZON_TYPE))

    # -- what the node may see ---------------------------------------------------------------------

    def _next(self, triggered_by: str, busy_until_ns: int) -> None:
        """Answer with the newest trigger and all that may be seen when the node takes it up."""
        trigger = self._inlets[triggered_by]
        self._accepted_ns = self._handed_ns
        start = self._next_start(trigger, busy_until_ns)
        if start is None:
            self._node.answer(NEVER_NS)
            return
        inlets = list(self._inlets.values())
        self._await_inlets([one for one in inlets if one is not trigger], start)
        queued = trigger.channel.take(start, inclusive=True)
        self._handed_ns = queued[-1].ready_ns
        seen = [
            (place, message)
            for place, one in enumerate(inlets)
            for message in (queued[-1:] if one is trigger else one.take(start))
        ]
        self._node.answer(start, len(queued) - 1, line.pack(seen))

    def _next_start(self, trigger: Inlet, busy_until_ns: int) -> int | None:
        """Wait for the next trigger, passing on meanwhile how long the node will stay silent."""
        channel = trigger.channel

        def settled() -> bool:
            self.promise(earliest_activation(channel, busy_until_ns), busy_until_ns)
            exhausted = channel.head is None and channel.horizon_ns >= NEVER_NS
            return exhausted or next_activation(channel, busy_until_ns) is not None

        self._wait(settled)
        return next_activation(channel, busy_until_ns)

    def _advance(self, until_ns: int) -> None:
        """Answer with all that is published before ``until_ns``."""
        inlets = list(self._inlets.values())
        self._await_inlets(inlets, until_ns)
        seen: list[tuple[int, Stamped]] = [
            (number, message) for number, one in enumerate(inlets) for message in one.take(until_ns)
        ]
        self._node.answer(until_ns, 0, line.pack(seen))

    def _busy_until(self, stage: str, accepted_ns: int) -> int:
        """Wait until ``stage`` has dealt with its trigger of that time; how long it is busy then."""
        self._wait(lambda: self._heard[stage] is not None and self._heard[stage].accepted_ns >= accepted_ns)
        return int(self._heard[stage].busy_until_ns)

    def _await_inlets(self, inlets: Iterable[Inlet], now_ns: int) -> None:
        """Wait until all that may be seen at ``now_ns`` is here."""
        self._wait(lambda: all(one.complete(now_ns) for one in inlets))

    # -- asking others -----------------------------------------------------------------------------

    def _ask(self, asked: bytes, timeout_s: float) -> None:
        """Pass a question of the node on, and answer with what is replied first."""
        key, _, payload = asked.partition(b"\0")
        inbox = self._inbox
        self._replies.clear()
        self._asking = True
        replied: Callback[zenoh.Reply] = Callback(
            lambda reply: inbox.put(("reply", reply)),
            lambda: inbox.put(("answered", None)),
            indirect=False,
        )
        self.session.get(key.decode(), replied, payload=payload, timeout=timeout_s)
        self._wait(lambda: not self._asking, at_a_loss=lambda: None)
        self._node.answer(len(self._replies), 0, self._replies[0] if self._replies else b"")

    # -- receiving ---------------------------------------------------------------------------------

    def _wait(self, settled: Callable[[], bool], at_a_loss: Callable[[], None] | None = None) -> None:
        """Take in what comes until ``settled``; ask the recorder when nothing does.

        :raises NodeGoneError: if the node has ended.
        """
        patience = PATIENCE_S
        while not settled():
            try:
                label, arrived = self._inbox.get(timeout=patience)
            except queue.Empty:
                (at_a_loss or self._recover)()
                patience = min(2 * patience, 1.0)
                continue
            self._take_in(label, arrived)
            while not self._inbox.empty():
                self._take_in(*self._inbox.get())

    def _take_in(self, label: str, arrived: Any) -> None:
        kind, _, stage = label.partition("/")
        if kind == "horizon":
            self._hear(stage, arrived.payload.to_bytes())
        elif kind == "child":
            if os.waitid(os.P_PID, self._node_pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
                raise NodeGoneError
        elif kind == "present":
            self._present.add(announce.Announcement.parse(str(arrived.key_expr)).name)
        elif kind == "reply":
            if arrived.ok is not None:
                self._replies.append(arrived.ok.payload.to_bytes())
        elif kind == "answered":
            self._asking = False
        else:
            self._receive(self._inlets[label], arrived)

    def _receive(self, inlet: Inlet, sample: zenoh.Sample) -> None:
        channel, page = inlet.channel, self._page
        doubled = channel.duplicates
        try:
            channel.receive(session.stamped(sample))
        except MalformedMessageError:
            page["unreadable"] += 1
        if channel.duplicates == doubled:
            return
        # What comes again after the recorder's answer was not lost, only slower.
        if page["recovered"] > 0:
            page["recovered"] -= 1
        else:
            page["doubled"] += 1

    def _hear(self, stage: str, payload: bytes) -> None:
        try:
            message = promise_of(stage, payload)
        except MalformedMessageError:
            self._page["unreadable"] += 1
            return
        heard = self._heard[stage]
        if heard is None or message.serial > heard.serial:
            self._heard[stage] = message
        for topic, count, until_ns in zip(published_by(stage), message.count, message.until_ns, strict=True):
            if topic.name in self._inlets:
                self._inlets[topic.name].channel.promise(int(count), int(until_ns))

    def _recover(self) -> None:
        """Fetch from the recorder what was published before our subscription was known."""
        for name, one in self._inlets.items():
            known = one.channel.next_seq
            for reply in self._fetch(f"{session.HISTORY_KEY}/{name}", str(known)):
                one.channel.receive(session.stamped(reply))
            self._page["recovered"] += one.channel.next_seq - known
        for stage in self._heard:
            for reply in self._fetch(f"{session.HISTORY_KEY}/horizon/{stage}", ""):
                self._hear(stage, reply.payload.to_bytes())

    def _fetch(self, key: str, payload: str) -> Iterator[zenoh.Sample]:
        replies = self.session.get(
            key, payload=payload, consolidation=zenoh.ConsolidationMode.NONE, timeout=10.0
        )
        for reply in replies:
            if reply.ok is not None:
                yield reply.ok

    def _flush(self) -> None:
        """Wait until the recorder has the last word: what a session has not sent when it closes is lost.

        A node that died has messages out that no promise speaks of yet. The last one holds for them, too.

        :raises BusError: if it does not get it.
        """
        if not self._promised:
            self._promised = (self._accepted_ns, self._setup.start_ns, *(0 for _ in self._outlets))
        self._send_promise()
        deadline = time.monotonic() + FLUSH_S
        while not any(
            decode(reply.payload.to_bytes(), HORIZON_TYPE).serial >= self._serial
            for reply in self._fetch(f"{session.HISTORY_KEY}/horizon/{self.name}", "")
        ):
            if time.monotonic() > deadline:
                message = f"{self.name}: the recorder does not answer"
                raise session.BusError(message)
            time.sleep(0.001)
