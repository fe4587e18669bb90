"""The runtime of a node: inputs and outputs by virtual time, kernels with their latencies.

A stage's file declares inputs, loops over :meth:`Node.spin`, calls its kernels within
:meth:`Node.kernel` and publishes; everything about time, order, loss and dying is here. The
simulator, which owns the clock, calls :meth:`Node.advance` and :meth:`Node.promise` instead.
"""

from __future__ import annotations

import json
import queue
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Literal

import numpy as np
import zenoh

from services.bus import announce, session
from services.bus.horizon import NEVER_NS, Stamped, earliest_activation, next_activation
from services.bus.latency import Latency
from services.bus.messages import Horizon, Injection, MalformedMessageError, decode, encode
from services.bus.mission import MissionSpec
from services.bus.model import Strict
from services.bus.platform import KernelLatency
from services.bus.ports import Input, Output, as_it_is, promise_of
from services.bus.recovery import Recovery
from services.bus.source_fault import SourceFault
from services.bus.topics import HORIZON_TYPE, PLANNER, TOPICS, published_by
from services.bus.vitals import Vitals

PATIENCE_S = 0.05
"""Wall time without any message after which a waiting node asks the recorder for what it missed."""

LINKING_S = 0.2
"""Longest wait for links to all other nodes; one may be dead."""

GATE_TIMEOUT_S = 60.0
FLUSH_S = 10.0
GATE_SIGNAL = signal.SIGURG
"""Marks the beginning and the end of an armed call to the tracer; ignored by default."""

LIFE_SHIFT = 32


class BusError(Exception):
    """The bus failed us: our own failure, never a result."""


class NodeSetup(Strict):
    """What a node is told when it is started.

    ``life`` counts its starts, ``start_ns`` is the virtual time at which it is there, ``published``
    says how many messages of its topics exist, ``resume_from`` where its inputs begin.
    """

    name: str
    spec: MissionSpec
    kernels: list[str]
    latencies: dict[str, KernelLatency]
    expected: list[str]
    life: int = 0
    start_ns: int = 0
    published: dict[str, int] = {}
    resume_from: dict[str, int] = {}


class Node:
    """One process on the bus."""

    def __init__(self, setup: NodeSetup, meeting: session.Meeting, vitals: Vitals) -> None:
        self.name = setup.name
        self.spec = setup.spec
        self.now_ns = setup.start_ns
        self.session = session.open_session(meeting, self.name)
        self._setup = setup
        self._page = vitals.page
        self._latencies = {
            kernel: Latency(stated, setup.spec.seed, kernel, setup.life)
            for kernel, stated in setup.latencies.items()
        }
        fault = setup.spec.fault
        self._source_fault = (
            SourceFault(fault, setup.spec.seed) if fault is not None and fault.level == "source" else None
        )
        self.recovery = Recovery(self.count, self._corrupt)
        self._inbox: queue.SimpleQueue[tuple[str, zenoh.Sample]] = queue.SimpleQueue()
        self._inputs: dict[str, Input] = {}
        self._declared: list[Any] = []
        self._heard: dict[str, Any] = {}
        self._accepted_ns = setup.start_ns - 1
        self._serial = setup.life << LIFE_SHIFT
        self._promised: tuple[int, ...] = ()
        self._tick: AbstractContextManager[None] | None = None
        topics = published_by(self.name)
        self._outputs = {
            topic.name: Output(
                self.name, topic, self._lookahead_ns(topic.after), setup.published.get(topic.name, 0)
            )
            for topic in topics
        }
        self._rank = topics[0].rank
        for output in self._outputs.values():
            output.declare(self.session)
        self._horizon = self.session.declare_publisher(
            session.horizon_key(self.name), congestion_control=zenoh.CongestionControl.BLOCK
        )

    def _lookahead_ns(self, kernels: tuple[str, ...]) -> int:
        names = (self.spec.planner if name == PLANNER else name for name in kernels)
        return sum(self._latencies[name].least_ns for name in names)

    # -- declaring ---------------------------------------------------------------------------------

    def input(self, name: str, parse: Callable[[Any], Any] = as_it_is) -> Input:
        """Subscribe to a topic; ``parse`` as in :class:`Input`."""
        topic = TOPICS[name]
        first_seq = self._setup.resume_from.get(name, 0)
        self._inputs[name] = Input(
            topic, self._rank, first_seq, self._setup.start_ns, parse, lambda: self.count("malformed")
        )
        self._subscribe(session.topic_key(name), name)
        self.watch(topic.publisher)
        return self._inputs[name]

    def watch(self, stage: str) -> None:
        """Listen to the promises of a stage."""
        if stage not in self._heard:
            self._heard[stage] = None
            self._subscribe(session.horizon_key(stage), f"horizon/{stage}")

    def _subscribe(self, key: str, label: str) -> None:
        inbox = self._inbox
        self._declared.append(
            self.session.declare_subscriber(key, session.hand_over(lambda sample: inbox.put((label, sample))))
        )

    def ready(self) -> None:
        """Announce the node and wait until every node of the mission has announced itself.

        A node that announces itself before gossip has linked it to the others would miss their first
        messages and have to fetch them; so it waits a little, though nothing depends on it.
        """
        others = len(self._setup.expected) - 1
        deadline = time.monotonic() + LINKING_S
        while len(self.session.info.peers_zid()) < others and time.monotonic() < deadline:
            time.sleep(0.0005)
        own = announce.announcement(self.name)
        self._declared.append(self.session.liveliness().declare_token(own.key))
        missing = set(self._setup.expected) - {self.name}
        with self.session.liveliness().declare_subscriber(announce.ALL, history=True) as tokens:
            while missing:
                missing.discard(announce.Announcement.parse(str(tokens.recv().key_expr)).name)

    # -- publishing --------------------------------------------------------------------------------

    def put(self, topic: str, message: Any) -> Any:
        """Publish ``message`` as ready at the node's present virtual time; what was published."""
        begin = time.perf_counter_ns()
        self._corrupt(topic, message)
        self._outputs[topic].put(message, self.now_ns)
        self._page["published"][list(self._outputs).index(topic)] += 1
        self._page["messaging_wall_ns"] += time.perf_counter_ns() - begin
        return message

    def _corrupt(self, topic: str, message: Any) -> None:
        """Let the mission's source-level fault strike ``message``, the topic's next, if it is the one."""
        fault = self._source_fault
        if fault is None or fault.topic != topic:
            return
        record = fault.strike(message, self._outputs[topic].published, self.now_ns)
        if record is not None:
            told = Injection(record=record.model_dump_json(by_alias=True))
            self.session.put(session.topic_key("injection"), encode(told, TOPICS["injection"].type))

    def promise(self, base_ns: int, busy_until_ns: int) -> None:
        """Tell the followers that nothing more is triggered before ``base_ns``."""
        until = [min(base_ns + output.lookahead_ns, NEVER_NS) for output in self._outputs.values()]
        promised = (self._accepted_ns, busy_until_ns, *until)
        if promised == self._promised:
            return
        begin = time.perf_counter_ns()
        self._promised = promised
        self._serial += 1
        message = Horizon(
            serial=self._serial,
            accepted_ns=self._accepted_ns,
            busy_until_ns=busy_until_ns,
            until_ns=np.array(until, dtype=np.int64),
            count=np.array([output.published for output in self._outputs.values()], dtype=np.uint64),
        )
        self._horizon.put(encode(message, HORIZON_TYPE))
        self._page["messaging_wall_ns"] += time.perf_counter_ns() - begin

    # -- the loop of a stage -----------------------------------------------------------------------

    def spin(self, trigger: Input) -> Iterator[Stamped]:
        """Yield the trigger's messages, each at the virtual time at which the stage is free for it.

        While the body of the loop runs, ``now_ns`` is the virtual time and every other input shows
        what may be seen at that time. Ends when no trigger can follow.
        """
        page = self._page
        others = [one for one in self._inputs.values() if one is not trigger]
        busy_until = self._setup.start_ns
        while True:
            start = self._next_start(trigger, busy_until)
            if start is None:
                return
            self._await_inputs(others, start)
            queued = trigger.channel.take(start, inclusive=True)
            for one in others:
                one.deliver(start)
            self.now_ns = start
            page["dropped"] += len(queued) - 1
            with self._step():
                yield queued[-1]
            self._accepted_ns = queued[-1].ready_ns
            busy_until = self.now_ns

    def _next_start(self, trigger: Input, busy_until_ns: int) -> int | None:
        """Wait for the next trigger, passing on meanwhile how long the node will stay silent."""
        channel = trigger.channel

        def settled() -> bool:
            self.promise(earliest_activation(channel, busy_until_ns), busy_until_ns)
            exhausted = channel.head is None and channel.horizon_ns >= NEVER_NS
            return exhausted or next_activation(channel, busy_until_ns) is not None

        self._wait(settled)
        return next_activation(channel, busy_until_ns)

    @contextmanager
    def _step(self) -> Iterator[None]:
        page = self._page
        begin, elsewhere = time.perf_counter_ns(), int(page["messaging_wall_ns"] + page["waiting_wall_ns"])
        page["step_ns"] = self.now_ns
        page["computing"] = 1
        yield
        page["computing"] = 0
        page["steps"] += 1
        elsewhere -= int(page["messaging_wall_ns"] + page["waiting_wall_ns"])
        page["compute_wall_ns"] += time.perf_counter_ns() - begin + elsewhere

    @contextmanager
    def kernel(self, name: str) -> Iterator[None]:
        """Run a kernel: counted, timed, stopped at the injector's gate if armed; takes virtual time."""
        page, index = self._page, self._setup.kernels.index(name)
        invocation = int(page["invocations"][index])
        fault = self.spec.fault
        armed = (
            fault is not None
            and fault.trigger is not None
            and (fault.target, fault.trigger.invocation) == (name, invocation)
        )
        # Before the call: one that ends in a crash is not to be armed again in the next life.
        page["invocations"][index] += 1
        if armed:
            self._gate("enter", name)
            signal.raise_signal(GATE_SIGNAL)
        begin = time.thread_time_ns()
        yield
        spent = time.thread_time_ns() - begin
        if armed:
            signal.raise_signal(GATE_SIGNAL)
            self._gate("leave", name)
        page["cpu_ns"][index] += spent
        page["cpu_squares_ns2"][index] += float(spent) ** 2
        page["last_cpu_ns"][index] = spent
        self._elapse(name, invocation)

    def _elapse(self, kernel: str, invocation: int) -> None:
        """Let the time pass that a call takes on the mission's platform."""
        self.now_ns += self._latencies[kernel].of(invocation)

    def slow_ns(self, kernel: str) -> int:
        """The virtual time that a kernel seldom exceeds (one call in twenty) on the mission's platform."""
        return self._latencies[kernel].slow_ns

    def _gate(self, phase: str, kernel: str) -> None:
        """Let the injector take hold, or let go, of us.

        While it has, a signal to ourselves marks where the call begins and ends: the tracer sees it and
        takes it away, and without a tracer it is ignored.
        """
        request = {"phase": phase, "kernel": kernel, "virtual_time_ns": self.now_ns}
        replies = self.session.get(
            session.gate_key(self.name), payload=json.dumps(request), timeout=GATE_TIMEOUT_S
        )
        if not any(reply.ok for reply in replies):
            message = f"{self.name}: the injector did not answer at the gate of {kernel}"
            raise BusError(message)

    # -- the loop of the clock's owner -------------------------------------------------------------

    def advance(self, until_ns: int) -> None:
        """Wait until all that the stages publish before ``until_ns`` is here, and make it visible."""
        inputs = list(self._inputs.values())
        if self._tick is not None:
            self._tick.__exit__(None, None, None)
        self._await_inputs(inputs, until_ns)
        for one in inputs:
            one.deliver(until_ns)
        self.now_ns = until_ns
        self._tick = self._step()
        self._tick.__enter__()

    def busy_until(self, stage: str, accepted_ns: int) -> int:
        """Wait until ``stage`` has dealt with its trigger of that time; how long it is busy then."""
        self._wait(lambda: self._heard[stage] is not None and self._heard[stage].accepted_ns >= accepted_ns)
        return int(self._heard[stage].busy_until_ns)

    def skip(self) -> None:
        """Count a message that was not made because nobody would have taken it up."""
        self._page["dropped"] += 1

    def count(self, what: Literal["malformed", "outdated", "alarms", "recomputed"]) -> None:
        """Count a message that was refused, or an output that was alarmed or made again."""
        self._page[what] += 1

    # -- receiving ---------------------------------------------------------------------------------

    def _await_inputs(self, inputs: Sequence[Input], now_ns: int) -> None:
        """Wait until all that may be seen at ``now_ns`` is here."""
        self._wait(lambda: all(one.complete(now_ns) for one in inputs))

    def _wait(self, settled: Callable[[], bool]) -> None:
        """Take in messages until ``settled``; ask the recorder when nothing comes."""
        patience = PATIENCE_S
        while not settled():
            begin = time.perf_counter_ns()
            try:
                label, sample = self._inbox.get(timeout=patience)
            except queue.Empty:
                self._page["waiting_wall_ns"] += time.perf_counter_ns() - begin
                self._recover()
                patience = min(2 * patience, 1.0)
                continue
            self._page["waiting_wall_ns"] += time.perf_counter_ns() - begin
            self._take_in(label, sample)
            while not self._inbox.empty():
                self._take_in(*self._inbox.get())

    def _take_in(self, label: str, sample: zenoh.Sample) -> None:
        kind, _, stage = label.partition("/")
        if kind == "horizon":
            self._hear(stage, sample.payload.to_bytes())
        else:
            channel = self._inputs[label].channel
            doubled = channel.duplicates
            try:
                channel.receive(session.stamped(sample))
            except MalformedMessageError:
                self.count("malformed")
            if channel.duplicates == doubled:
                return
            # What comes again after the recorder's answer was not lost, only slower.
            if self._page["recovered"] > 0:
                self._page["recovered"] -= 1
            else:
                self.count("outdated")

    def _hear(self, stage: str, payload: bytes) -> None:
        try:
            message = promise_of(stage, payload)
        except MalformedMessageError:
            self.count("malformed")
            return
        heard = self._heard[stage]
        if heard is None or message.serial > heard.serial:
            self._heard[stage] = message
        for topic, count, until_ns in zip(published_by(stage), message.count, message.until_ns, strict=True):
            if topic.name in self._inputs:
                self._inputs[topic.name].channel.promise(int(count), int(until_ns))

    def _recover(self) -> None:
        """Fetch from the recorder what was published before our subscription was known."""
        for name, one in self._inputs.items():
            known = one.channel.next_seq
            for reply in self._ask(f"{session.HISTORY_KEY}/{name}", str(known)):
                one.channel.receive(session.stamped(reply))
            self._page["recovered"] += one.channel.next_seq - known
        for stage in self._heard:
            for reply in self._ask(f"{session.HISTORY_KEY}/horizon/{stage}", ""):
                self._hear(stage, reply.payload.to_bytes())

    def _ask(self, key: str, payload: str) -> Iterator[zenoh.Sample]:
        replies = self.session.get(
            key, payload=payload, consolidation=zenoh.ConsolidationMode.NONE, timeout=10.0
        )
        for reply in replies:
            if reply.ok is not None:
                yield reply.ok

    def flush(self) -> None:
        """Wait until the recorder has our last word: what a session has not sent when it closes is lost.

        :raises BusError: if it does not get it.
        """
        deadline = time.monotonic() + FLUSH_S
        while not any(
            decode(reply.payload.to_bytes(), HORIZON_TYPE).serial >= self._serial
            for reply in self._ask(f"{session.HISTORY_KEY}/horizon/{self.name}", "")
        ):
            if time.monotonic() > deadline:
                message = f"{self.name}: the recorder does not answer"
                raise BusError(message)
            time.sleep(0.001)

    def close(self) -> None:
        """Close the session."""
        self.session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Node:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.flush()
        self.close()
