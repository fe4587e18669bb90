"""The runtime of a node: inputs and outputs by virtual time, kernels with their latencies.

A stage's file declares inputs, loops over :meth:`Node.spin`, calls its kernels within
:meth:`Node.kernel` and publishes. The simulator is a :class:`ClockOwner`: it calls
:meth:`ClockOwner.advance` and :meth:`ClockOwner.promise` instead.

A node has one thread and no part in the bus: its proxy (:mod:`services.runtime.bus_proxy`), a process of
its own, sends and receives for it and decides what may be seen when. So all that a node executes, and where
its memory lies, follows from the flight alone.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Literal, Self

from services.bus import proxy_link, session
from services.bus.horizon import NEVER_NS, Stamped
from services.bus.messages import Injection, encode
from services.bus.ports import Input, Parse, as_it_is
from services.bus.proxy_link import Digest, NodeLink, OverheardLink, ProxyAnswer, SilentLink
from services.bus.topics import STAGES, TOPICS, published_by
from services.models.detection import DETECTOR, AlarmRecord
from services.models.outcome import InjectionRecord
from services.models.pilots import added_guards
from services.recovery.recovery import Recovery
from services.runtime.fault_reach import FaultReach
from services.runtime.guard_counts import GuardCounts
from services.runtime.kernel_timer import KernelTimer
from services.runtime.latency import VirtualLink
from services.runtime.setup import NodeSetup
from services.runtime.source_fault import SourceFault
from services.system.shared_stats import COMPUTING, MESSAGING, WAITING, SharedStats
from services.system.stopwatch import ActivityStopwatch

VERDICT_TIMEOUT_S = 600.0
"""Wall time. A detector that hangs is killed long before, and then the question ends unanswered."""

ALARM_TIMEOUT_S = 60.0

TOPIC_NUMBERS = {name: number for number, name in enumerate(TOPICS)}


class Node:
    """One stage or the simulator: its inputs, its outputs and its virtual time ``now_ns``."""

    def __init__(
        self, setup: NodeSetup, proxy: NodeLink, stats: SharedStats, timer: KernelTimer | None = None
    ) -> None:
        self.name = setup.name
        self.spec = setup.spec
        self.now_ns = setup.start_ns
        self._proxy = proxy
        self._setup = setup
        self._stats, self._page = stats, stats.page
        self._link = VirtualLink(setup.spec.link, setup.spec.seed)
        self.guards = GuardCounts(stats.page, setup.spec.active_guards)
        self._wall = ActivityStopwatch(stats.page)
        self.timer = timer if timer is not None else KernelTimer(setup, proxy, stats.page)
        fault = setup.spec.fault
        self._source_fault = (
            SourceFault(fault, setup.spec.seed, setup.start_ns)
            if fault is not None and fault.level == "source"
            else None
        )
        self._corrupted: Any = None
        self.recovery = Recovery(self, setup.spec.detector)
        self._inputs: dict[str, Input] = {}
        self._added = added_guards(setup.spec.active_guards, self.name)
        self._published = {
            topic.name: setup.published.get(topic.name, 0) for topic in published_by(self.name)
        }
        self.fault_reach = FaultReach(self.timer, self._source_fault, self._published)

    # -- declaring ---------------------------------------------------------------------------------

    def input(self, name: str, parse: Parse = as_it_is) -> Input:
        """Subscribe to a topic, checked by those guards of the mission that are checks of messages."""
        checks = self.spec.message_checks
        self._inputs[name] = Input(TOPICS[name], parse, checks, self.guards.refused, self._added)
        return self._inputs[name]

    def ready(self, *watched: str) -> None:
        """Announce the node, and wait until every node of the mission is announced.

        The proxy also follows the promises of the ``watched`` stages, of which there need be no input.
        """
        self._declare({"inputs": list(self._inputs), "watched": watched})

    def _declare(self, declared: dict[str, object]) -> None:
        self._await(proxy_link.READY, payload=json.dumps(declared).encode())

    # -- publishing --------------------------------------------------------------------------------

    def put(self, topic: str, message: Any) -> Any:
        """Publish ``message`` as ready at the node's virtual time; return what was published."""
        with self._wall.busy_with(MESSAGING):
            self.corrupt(topic, message)
            self._corrupted = None
            self._tell(topic, message)
            self._published[topic] += 1
        self.recovery.published(topic)
        return message

    def _tell(self, topic: str, message: Any) -> None:
        arrival_ns = self._link.arrival_ns(topic, self.now_ns)
        if arrival_ns is None:
            self._page["lost"] += 1
            return
        payload = encode(message, TOPICS[topic].type)
        self._proxy.tell(proxy_link.PUT, TOPIC_NUMBERS[topic], arrival_ns, payload=payload)

    def corrupt(self, topic: str, message: Any) -> None:
        """Let the mission's source-level fault strike ``message``, the topic's next, if it is the one.

        A message has one chance, whether it is shown to a detector before it is published or not.
        """
        fault = self._source_fault
        if fault is None or fault.topic != topic or message is self._corrupted:
            return
        self._corrupted = message
        for record in fault.strike(message, self._published[topic], self.now_ns):
            self._tell("injection", Injection(record=record.model_dump_json(by_alias=True)))

    def tell_alarm(self, record: AlarmRecord) -> None:
        """Send an alarm to the recorder.

        :raises BusError: if nobody answers for it.
        """
        if self.ask(session.alarm_key(self.name), record.model_dump_json(), ALARM_TIMEOUT_S) is None:
            message = f"{self.name}: an alarm was not recorded"
            raise session.BusError(message)

    # -- the loop of a stage -----------------------------------------------------------------------

    def spin(self, trigger: Input) -> Iterator[Stamped]:
        """Yield the trigger's messages, each at the virtual time at which the stage is free for it.

        While the body of the loop runs, ``now_ns`` is the virtual time and every other input shows
        what may be seen at that time. Ends when no trigger can follow.
        """
        place = list(self._inputs.values()).index(trigger)
        busy_until = self._setup.start_ns
        while True:
            start, dropped, body = self._await(proxy_link.NEXT, place, busy_until)
            if start == NEVER_NS:
                return
            self._stats.begin_step(start)
            self._deliver(body)
            self.now_ns = start
            self._page["dropped"] += dropped
            with self._step():
                yield trigger.new[0]
            busy_until = self.now_ns

    @contextmanager
    def _step(self) -> Iterator[None]:
        page = self._page
        with self._wall.busy_with(COMPUTING):
            page["step_ns"] = self.now_ns
            page["computing"] = 1
            yield
            page["computing"] = 0
            page["steps"] += 1

    def kernel(self, name: str) -> AbstractContextManager[None]:
        """Run a kernel in a ``with`` statement: counted, timed, stopped at the injector's gate if armed."""
        return self.timer.call(name, self)

    def elapse_check(self, number: int) -> None:
        """Advance the virtual time by the latency of this node's ``number``-th check by the detector."""
        self.now_ns = self.timer.end_ns(self.now_ns, DETECTOR, number)

    def verdict(self, payload: bytes) -> bytes | None:
        """The detector's answer to a question; None if it is dead."""
        self._page["asking"] = 1
        answer = self.ask(session.verdict_key(self.name), payload, VERDICT_TIMEOUT_S)
        self._page["asking"] = 0
        return answer

    @contextmanager
    def overheard(self, digest: Digest, *, in_a_copy: bool) -> Iterator[None]:
        """Add all that is published in the body of a ``with`` statement to a digest, too.

        In a copy of the node, a fork that ends with the body, it goes nowhere else, nothing is counted or
        asked for, and no fault strikes.
        """
        proxy = self._proxy
        if in_a_copy:
            proxy = SilentLink()
            self._page = self._page.copy()
            self._wall = ActivityStopwatch(self._page)
            self.timer.become_copy(proxy, self._page)
            self.guards = GuardCounts(self._page, self.spec.active_guards)
            self._source_fault = None
        self._proxy = OverheardLink(proxy, digest)
        try:
            yield
        finally:
            self._proxy = proxy

    def count(self, what: Literal["malformed", "outdated", "alarms", "recomputed", "ungated"]) -> None:
        """Count a message that was refused, or an output that was alarmed, made again or not judged."""
        self._page[what] += 1

    # -- asking ------------------------------------------------------------------------------------

    def ask(self, key: str, payload: bytes | str, timeout_s: float) -> bytes | None:
        """Ask whoever answers for ``key`` on the bus; None if nobody does in time, or it dies."""
        asked = payload.encode() if isinstance(payload, str) else payload
        answer = self._await(proxy_link.ASK, 0, round(timeout_s * 1e9), key.encode() + b"\0" + asked)
        return answer.body if answer.value else None

    def _await(self, kind: int, place: int = 0, first: int = 0, payload: bytes = b"") -> ProxyAnswer:
        with self._wall.busy_with(WAITING):
            return self._proxy.ask(kind, place, first, payload=payload)

    def _deliver(self, body: bytes) -> None:
        inputs = list(self._inputs.values())
        come: list[list[Stamped]] = [[] for _ in inputs]
        for place, message in proxy_link.unpack(body):
            come[place].append(message)
        for one, messages in zip(inputs, come, strict=True):
            one.deliver(messages)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._proxy.close()


class ClockOwner(Node):
    """The node that owns the clock: it begins each tick, and reports how long it will be silent."""

    def __init__(self, setup: NodeSetup, proxy: NodeLink, stats: SharedStats) -> None:
        super().__init__(setup, proxy, stats)
        self._tick: AbstractContextManager[None] | None = None
        self._busy: dict[str, tuple[int, int]] = {}

    def promise(self, base_ns: int, busy_until_ns: int) -> None:
        """Publish a promise: this node is not triggered again before ``base_ns``."""
        self._proxy.tell(proxy_link.PROMISE, 0, base_ns, busy_until_ns)

    def advance(self, until_ns: int) -> None:
        """Wait until all that the stages publish before ``until_ns`` is here, and make it visible."""
        if self._tick is not None:
            self._tick.__exit__(None, None, None)
        self._deliver(self._await(proxy_link.ADVANCE, 0, until_ns).body)
        self.now_ns = until_ns
        self._tick = self._step()
        self._tick.__enter__()

    def busy_until(self, stage: str, accepted_ns: int) -> int:
        """Wait until ``stage`` has dealt with its trigger of that time; how long it is busy then."""
        if self._busy.get(stage, (None, 0))[0] != accepted_ns:
            busy_until_ns = self._await(proxy_link.BUSY_UNTIL, STAGES.index(stage), accepted_ns).value
            self._busy[stage] = accepted_ns, busy_until_ns
        return self._busy[stage][1]

    def tell_injections(self, records: list[InjectionRecord]) -> None:
        """Send records of a fault of the simulator's equipment to the recorder, and empty the list."""
        for record in records:
            self._tell("injection", Injection(record=record.model_dump_json(by_alias=True)))
        records.clear()

    def skip(self) -> None:
        """Count a message that was not made because nobody would have taken it up."""
        self._page["dropped"] += 1
