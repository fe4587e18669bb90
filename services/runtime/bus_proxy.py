"""The proxy: a small process beside each node that connects the node to the bus.

It sends what the node publishes, takes in what the node may see once that is complete, passes on how long
the node will be silent, and announces the node's process. What depends on when messages come stays here.
It outlives its node until all that the node said is delivered; the node does not outlive it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Container, Iterable, Sequence

from services.bus import announce, proxy_link, session
from services.bus.horizon import NEVER_NS, Promise, Stamped, earliest_activation, next_activation
from services.bus.ports import Inlet, Outlet, promise_of
from services.bus.proxy_link import Frame, ProxyLink
from services.bus.topics import CARRIERS, STAGES, TOPICS, Topic, published_by
from services.runtime.bus_listener import BusListener, NodeGoneError
from services.runtime.latency import Latency, VirtualLink
from services.runtime.setup import NodeSetup
from services.system.process_stat import listed_pid, process_stat
from services.system.shared_stats import SharedStats

LINKING_S = 0.2
"""Longest wait for links to all other nodes; one may be dead."""

FLUSH_S = 10.0
"""Longest wait for the recorder to have the last promise."""

LIFE_SHIFT = 32
"""Serial numbers of promises begin with the number of restarts, in the bits from here on."""

_TOPICS = tuple(TOPICS)


class BusProxy:
    """The bus as one node sees it. To be used by a process with no other thread of its own."""

    def __init__(
        self,
        setup: NodeSetup,
        address: session.BusAddress,
        node: ProxyLink,
        node_pid: int,
        stats: SharedStats,
    ) -> None:
        self.name = setup.name
        self._setup = setup
        self._node = node
        self._node_pid = node_pid
        self._page = stats.page
        self._accepted_ns = self._handed_ns = setup.start_ns - 1
        self._serial = setup.life << LIFE_SHIFT
        self._promised: tuple[int, ...] = ()
        self._carrier = CARRIERS.get(self.name, "")
        self._held: tuple[bytes, int] | None = None
        self.session = session.open_session(address, self.name)
        self._listener = BusListener(self.session, node_pid, stats.page)
        self._rank = published_by(self.name)[0].rank
        self._outlets = {
            topic.name: Outlet(
                self.session,
                self.name,
                topic,
                _lookahead_ns(setup, topic),
                setup.published.get(topic.name, 0),
            )
            for topic in published_by(self.name)
        }
        self._horizon = session.declare_publisher(self.session, session.horizon_key(self.name))
        self._injections = session.declare_publisher(self.session, session.topic_key("injection"))

    # -- serving the node --------------------------------------------------------------------------

    def serve(self) -> None:
        """Serve the node's requests until it hangs up or dies, then wait until all has arrived.

        :raises NonsenseError: if it sends what no node sends.
        :raises BusError: if the bus fails us.
        """
        self._listener.notice_end_of_node()
        try:
            while (frame := self._node.hear()) is not None:
                try:
                    self._do(frame)
                except NodeGoneError:
                    continue  # what it had sent before is still in the socket
        finally:
            self._flush()
            self.session.close()  # type: ignore[no-untyped-call]

    def _do(self, frame: Frame) -> None:
        kind, place, first, second, payload = frame
        listener = self._listener
        if kind not in (proxy_link.PUT, proxy_link.PROMISE, proxy_link.NEXT):
            self._send_held()
        if kind == proxy_link.PUT:
            self._put(self._known(_TOPICS, place, (*self._outlets, "injection")), payload, first)
        elif kind == proxy_link.PROMISE:
            self.promise(first, second)
        elif kind == proxy_link.NEXT:  # which makes a promise first
            self._next(self._known(tuple(listener.inlets), place, listener.inlets), first)
        elif kind == proxy_link.ADVANCE:
            self._advance(first)
        elif kind == proxy_link.BUSY_UNTIL:
            self._node.answer(self._busy_until(self._known(STAGES, place, listener.promises), first))
        elif kind == proxy_link.ASK:
            self._ask(payload, first / 1e9)
        elif kind == proxy_link.READY:
            self._ready(**json.loads(payload))

    def _known(self, names: Sequence[str], place: int, own: Container[str]) -> str:
        """The name at a place, if it is one of our own: a node that was struck may send anything."""
        if place < len(names) and names[place] in own:
            return names[place]
        message = f"{self.name} speaks of number {place} of {', '.join(names)}"
        raise proxy_link.NonsenseError(message)

    # -- getting ready -----------------------------------------------------------------------------

    def _ready(self, inputs: list[str], watched: list[str], program: int | None = None) -> None:
        """Announce the node, or the ``program`` that computes for it, and wait until every node is announced.

        One that is restarted waits for nobody: others may have ended since, as the simulator does with the
        mission. A node that is announced before gossip has linked it to the others would miss their first
        messages and have to fetch them; so it waits a little, though nothing depends on it.
        """
        for name in inputs:
            first_seq = self._setup.resume_from.get(name, 0)
            inlet = Inlet(TOPICS[name], self._rank, first_seq, self._setup.start_ns)
            self._listener.subscribe(name, inlet)
        for stage in dict.fromkeys([*(TOPICS[name].publisher for name in inputs), *watched]):
            self._listener.follow(stage)
        others = len(self._setup.expected) - 1
        deadline = time.monotonic() + LINKING_S
        while len(self.session.info.peers_zid()) < others and time.monotonic() < deadline:
            time.sleep(0.0005)
        own = announce.announcement(self.name, self._computing(program))
        awaited = set(self._setup.expected) - {self.name} if self._setup.life == 0 else set()
        self._listener.announce(own.key, awaited)
        self._node.answer(0)

    def _computing(self, program: int | None) -> int:
        """The process that computes: the node, or a child of it; no other pid is announced."""
        node = listed_pid(self._node_pid)
        if program is None:
            return node
        try:
            parent = process_stat(program).parent
        except OSError:
            raise NodeGoneError from None  # it died before it was announced, and its node with it
        if parent != node:
            message = f"{self.name} speaks of process {program}, which is none of its own"
            raise proxy_link.NonsenseError(message)
        return program

    # -- publishing --------------------------------------------------------------------------------

    def _put(self, topic: str, payload: bytes, ready_ns: int) -> None:
        if topic == "injection":
            self._injections.put(payload)
            return
        outlets = list(self._outlets)
        promised = self._promised[2 + outlets.index(topic)] if self._promised else 0
        if ready_ns < promised:
            # Others may have gone on already, sooner or later as the machine goes: it would not repeat.
            message = f"{self.name} has {topic} at {ready_ns} ns, and promised none before {promised}"
            raise proxy_link.NonsenseError(message)
        if topic == self._carrier:
            self._send_held()
            self._held = payload, ready_ns
        else:
            self._outlets[topic].put(payload, ready_ns)

    def _send_held(self, promise: bytes = b"") -> bool:
        """Send the message that has waited for a promise to carry; False if there is none."""
        if self._held is None:
            return False
        held, self._held = self._held, None
        self._outlets[self._carrier].put(*held, promise)
        return True

    def promise(self, base_ns: int, busy_until_ns: int) -> None:
        """Publish a promise: this node is not triggered again before ``base_ns``."""
        until = [min(base_ns + outlet.lookahead_ns, NEVER_NS) for outlet in self._outlets.values()]
        before, self._promised = self._promised, (self._accepted_ns, busy_until_ns, *until)
        if self._promised != before:
            self._send_promise()
        else:
            self._send_held()

    def _send_promise(self) -> None:
        accepted_ns, busy_until_ns, *until = self._promised
        self._serial += 1
        held = self._carrier if self._held is not None else ""
        count = tuple(outlet.published + (name == held) for name, outlet in self._outlets.items())
        promise = Promise(self._serial, accepted_ns, busy_until_ns, tuple(until), count).packed()
        if not self._send_held(promise):
            self._horizon.put(promise)

    # -- what the node may see ---------------------------------------------------------------------

    def _next(self, triggered_by: str, busy_until_ns: int) -> None:
        """Answer with the newest trigger and all that may be seen when the node takes it up."""
        trigger = self._listener.inlets[triggered_by]
        self._accepted_ns = self._handed_ns
        start = self._next_start(trigger, busy_until_ns)
        if start is None:
            self._node.answer(NEVER_NS)
            return
        inlets = list(self._listener.inlets.values())
        self._await_inlets([one for one in inlets if one is not trigger], start)
        queued = trigger.channel.take(start, inclusive=True)
        self._handed_ns = queued[-1].ready_ns
        seen = [
            (place, message)
            for place, one in enumerate(inlets)
            for message in (queued[-1:] if one is trigger else one.take(start))
        ]
        self._node.answer(start, len(queued) - 1, proxy_link.pack(seen))

    def _next_start(self, trigger: Inlet, busy_until_ns: int) -> int | None:
        """Wait for the next trigger, passing on meanwhile how long the node will stay silent."""
        channel = trigger.channel

        def done() -> bool:
            self.promise(earliest_activation(channel, busy_until_ns), busy_until_ns)
            exhausted = channel.head is None and channel.horizon_ns >= NEVER_NS
            return exhausted or next_activation(channel, busy_until_ns) is not None

        self._listener.wait(done)
        return next_activation(channel, busy_until_ns)

    def _advance(self, until_ns: int) -> None:
        """Answer with all that is published before ``until_ns``."""
        inlets = list(self._listener.inlets.values())
        self._await_inlets(inlets, until_ns)
        seen: list[tuple[int, Stamped]] = [
            (number, message) for number, one in enumerate(inlets) for message in one.take(until_ns)
        ]
        self._node.answer(until_ns, 0, proxy_link.pack(seen))

    def _busy_until(self, stage: str, accepted_ns: int) -> int:
        """Wait until ``stage`` has dealt with its trigger of that time; how long it is busy then."""
        promises = self._listener.promises
        self._listener.wait(
            lambda: promises[stage] is not None and promises[stage].accepted_ns >= accepted_ns
        )
        return int(promises[stage].busy_until_ns)

    def _await_inlets(self, inlets: Iterable[Inlet], now_ns: int) -> None:
        """Wait until all that may be seen at ``now_ns`` is here."""
        self._listener.wait(lambda: all(one.complete(now_ns) for one in inlets))

    # -- asking others, and the end ----------------------------------------------------------------

    def _ask(self, asked: bytes, timeout_s: float) -> None:
        """Pass a question of the node on, and answer with the first reply."""
        key, _, payload = asked.partition(b"\0")
        replies = self._listener.ask(key.decode(), payload, timeout_s)
        self._node.answer(len(replies), 0, replies[0] if replies else b"")

    def _flush(self) -> None:
        """Wait until the recorder has all messages: a session that closes loses what it has not sent.

        A node that died has messages out that no promise speaks of yet. The last one holds for them, too.

        :raises BusError: if it does not get it.
        """
        if not self._promised:
            self._promised = (self._accepted_ns, self._setup.start_ns, *(0 for _ in self._outlets))
        self._send_promise()
        deadline = time.monotonic() + FLUSH_S
        while not any(
            promise_of(self.name, sample.payload.to_bytes()).serial >= self._serial
            for sample in self._listener.history(f"horizon/{self.name}")
        ):
            if time.monotonic() > deadline:
                message = f"{self.name}: the recorder does not answer"
                raise session.BusError(message)
            time.sleep(0.001)


def _lookahead_ns(setup: NodeSetup, topic: Topic) -> int:
    """From when a topic's publisher is triggered until a message of it is ready at the earliest."""
    spec, stated, life = setup.spec, setup.latencies, setup.life
    kernels = spec.kernels_before(topic)
    computed = sum(Latency(stated[name], spec.seed, name, life).least_ns for name in kernels)
    return computed + VirtualLink(spec.link, spec.seed).least_ns(topic.name)
