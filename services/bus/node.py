"""The runtime of a node: inputs and outputs by virtual time, kernels with their latencies.

A stage's file declares inputs, loops over :meth:`Node.spin`, calls its kernels within
:meth:`Node.kernel` and publishes. The simulator, which owns the clock, calls :meth:`Node.advance` and
:meth:`Node.promise` instead.

A node has one thread and no part in the bus: its courier (:mod:`services.bus.courier`), a process of its
own, sends and receives for it and settles what may be seen when. So all that a node executes, and where
its memory lies, follows from the flight alone.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Literal, Self

from services.bus import line, session
from services.bus.detection import AlarmRecord
from services.bus.horizon import NEVER_NS, Stamped
from services.bus.latency import Latency
from services.bus.line import Answer, Line
from services.bus.messages import Injection, encode
from services.bus.mission import MissionSpec
from services.bus.model import Strict
from services.bus.platform import KernelLatency
from services.bus.ports import Input, as_it_is
from services.bus.recovery import Recovery
from services.bus.scout import stand_at_gate
from services.bus.source_fault import SourceFault
from services.bus.topics import STAGES, TOPICS, published_by
from services.bus.vitals import Vitals

GATE_TIMEOUT_S = 60.0
VERDICT_TIMEOUT_S = 600.0
"""Wall time. A detector that hangs is killed long before, and then the question ends unanswered."""

ALARM_TIMEOUT_S = 60.0

DETECTOR = "detector"
"""Among the latencies: that of one check."""

GATE_SIGNAL = signal.SIGURG
"""Marks the beginning and the end of an armed call to the tracer; ignored by default."""

TOPIC_NUMBERS = {name: number for number, name in enumerate(TOPICS)}


class NodeSetup(Strict):
    """What a node is told when it is started.

    ``life`` counts its starts, ``start_ns`` is the virtual time at which it is there, ``published``
    says how many messages of its topics exist, ``resume_from`` where its inputs begin; ``clock`` is the
    page of the flight's clock in real time.
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
    clock: Path | None = None


class Node:
    """One stage, at its end of the line."""

    def __init__(self, setup: NodeSetup, courier: Line, vitals: Vitals) -> None:
        self.name = setup.name
        self.spec = setup.spec
        self.now_ns = setup.start_ns
        self._courier = courier
        self._setup = setup
        self._fault = setup.spec.fault
        self._page = vitals.page
        self._page["gated"] = 0
        self._latencies = {
            kernel: Latency(stated, setup.spec.seed, kernel, setup.life)
            for kernel, stated in setup.latencies.items()
        }
        fault = setup.spec.fault
        self._source_fault = (
            SourceFault(fault, setup.spec.seed) if fault is not None and fault.level == "source" else None
        )
        self.recovery = Recovery(self, setup.spec.detector)
        self._inputs: dict[str, Input] = {}
        self._watched: list[str] = []
        self._tick: AbstractContextManager[None] | None = None
        self._busy: dict[str, tuple[int, int]] = {}
        self._published = {
            topic.name: setup.published.get(topic.name, 0) for topic in published_by(self.name)
        }

    # -- declaring ---------------------------------------------------------------------------------

    def input(self, name: str, parse: Callable[[Any], Any] = as_it_is) -> Input:
        """Subscribe to a topic; ``parse`` as in :class:`Input`."""
        self._inputs[name] = Input(TOPICS[name], parse, lambda: self.count("malformed"))
        return self._inputs[name]

    def watch(self, stage: str) -> None:
        """Have the courier listen to the promises of a stage of which there is no input."""
        self._watched.append(stage)

    def ready(self) -> None:
        """Be announced, and wait until every node of the mission is."""
        self._declare({"inputs": list(self._inputs), "watched": self._watched})

    def _declare(self, declared: dict[str, object]) -> None:
        self._await(line.READY, payload=json.dumps(declared).encode())

    # -- publishing --------------------------------------------------------------------------------

    def put(self, topic: str, message: Any) -> Any:
        """Publish ``message`` as ready at the node's present virtual time; what was published."""
        begin = time.perf_counter_ns()
        self.corrupt(topic, message)
        self._tell(topic, message)
        self._published[topic] += 1
        self._page["messaging_wall_ns"] += time.perf_counter_ns() - begin
        self.recovery.published(topic)
        return message

    def _tell(self, topic: str, message: Any) -> None:
        payload = encode(message, TOPICS[topic].type)
        self._courier.tell(line.PUT, TOPIC_NUMBERS[topic], self.now_ns, payload=payload)

    def corrupt(self, topic: str, message: Any) -> None:
        """Let the mission's source-level fault strike ``message``, the topic's next, if it is the one."""
        fault = self._source_fault
        if fault is None or fault.topic != topic:
            return
        record = fault.strike(message, self._published[topic], self.now_ns)
        if record is not None:
            self._tell("injection", Injection(record=record.model_dump_json(by_alias=True)))

    def tell_alarm(self, record: AlarmRecord) -> None:
        """Have an alarm recorded.

        :raises BusError: if nobody answers for it.
        """
        if self.ask(session.alarm_key(self.name), record.model_dump_json(), ALARM_TIMEOUT_S) is None:
            message = f"{self.name}: an alarm was not recorded"
            raise session.BusError(message)

    def promise(self, base_ns: int, busy_until_ns: int) -> None:
        """Tell the followers that nothing more is triggered before ``base_ns``."""
        self._courier.tell(line.PROMISE, 0, base_ns, busy_until_ns)

    # -- the loop of a stage -----------------------------------------------------------------------

    def spin(self, trigger: Input) -> Iterator[Stamped]:
        """Yield the trigger's messages, each at the virtual time at which the stage is free for it.

        While the body of the loop runs, ``now_ns`` is the virtual time and every other input shows
        what may be seen at that time. Ends when no trigger can follow.
        """
        place = list(self._inputs.values()).index(trigger)
        busy_until = self._setup.start_ns
        while True:
            start, dropped, body = self._await(line.NEXT, place, busy_until)
            if start == NEVER_NS:
                return
            self._deliver(body)
            self.now_ns = start
            self._page["dropped"] += dropped
            with self._step():
                yield trigger.new[0]
            busy_until = self.now_ns

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
        """Run a kernel: counted, timed, stopped at the injector's gate if armed; takes virtual time.

        What was published before goes out: it does not depend on what becomes of us.
        """
        self._courier.send()
        page, index = self._page, self._setup.kernels.index(name)
        invocation = int(page["invocations"][index])
        # Before the call: one that ends in a crash is not to be armed again in the next life.
        page["invocations"][index] += 1
        armed = self._is_armed(name, invocation)
        scouting = armed and self._gate("enter", name, invocation)
        begin = self._cpu_ns()
        if armed:
            signal.raise_signal(GATE_SIGNAL)
        try:
            yield
        finally:
            if scouting:
                signal.raise_signal(GATE_SIGNAL)
                os._exit(0)
        if armed:
            signal.raise_signal(GATE_SIGNAL)
        spent = self._cpu_ns() - begin
        if armed:
            self._gate("leave", name, invocation)
        page["cpu_ns"][index] += spent
        page["cpu_squares_ns2"][index] += float(spent) ** 2
        page["last_cpu_ns"][index] = spent
        self._elapse(name, invocation)

    def elapse_check(self, number: int) -> None:
        """Let the time of this node's ``number``-th check by the detector pass."""
        self._elapse(DETECTOR, number)

    def _elapse(self, kernel: str, invocation: int) -> None:
        """Let the time pass that a call takes on the mission's platform."""
        self.now_ns += self._latencies[kernel].of(invocation)

    def _is_armed(self, kernel: str, invocation: int) -> bool:
        """Whether this call is the one that the fault is for; at most one is in a node's life."""
        fault = self._fault
        if fault is None or fault.target != kernel or fault.trigger is None:
            return False
        if not fault.trigger.names(invocation, self.now_ns):
            return False
        self._fault = None
        return True

    def slow_ns(self, kernel: str) -> int:
        """The virtual time that a kernel seldom exceeds (one call in twenty) on the mission's platform."""
        return self._latencies[kernel].slow_ns

    def _gate(self, phase: str, kernel: str, invocation: int) -> bool:
        """Let the injector take hold, or let go, of us; True in a scout that it sends ahead.

        While it has, a signal to ourselves marks where the call begins and ends: the tracer sees it and
        takes it away, and without a tracer it is ignored.
        """
        request = json.dumps(
            {"phase": phase, "kernel": kernel, "invocation": invocation, "virtual_time_ns": self.now_ns}
        )
        self._page["gated"] = 1
        if self._stand_at_gate(session.gate_key(self.name), request):
            return True
        self._page["gated"] = 0
        return False

    def _stand_at_gate(self, key: str, request: str) -> bool:
        """Ask at the gate until it opens; True in a scout that is sent ahead."""
        return stand_at_gate(self._courier, line.question(key, request.encode(), GATE_TIMEOUT_S))

    def _cpu_ns(self) -> int:
        """Processor time of who computes."""
        return time.thread_time_ns()

    def verdict(self, payload: bytes) -> bytes | None:
        """The detector's answer to a question; None if it is dead."""
        self._page["asking"] = 1
        answer = self.ask(session.verdict_key(self.name), payload, VERDICT_TIMEOUT_S)
        self._page["asking"] = 0
        return answer

    # -- the loop of the clock's owner -------------------------------------------------------------

    def advance(self, until_ns: int) -> None:
        """Wait until all that the stages publish before ``until_ns`` is here, and make it visible."""
        if self._tick is not None:
            self._tick.__exit__(None, None, None)
        self._deliver(self._await(line.ADVANCE, 0, until_ns).body)
        self.now_ns = until_ns
        self._tick = self._step()
        self._tick.__enter__()

    def busy_until(self, stage: str, accepted_ns: int) -> int:
        """Wait until ``stage`` has dealt with its trigger of that time; how long it is busy then."""
        if self._busy.get(stage, (None, 0))[0] != accepted_ns:
            busy_until_ns = self._await(line.BUSY_UNTIL, STAGES.index(stage), accepted_ns).value
            self._busy[stage] = accepted_ns, busy_until_ns
        return self._busy[stage][1]

    def skip(self) -> None:
        """Count a message that was not made because nobody would have taken it up."""
        self._page["dropped"] += 1

    def count(self, what: Literal["malformed", "outdated", "alarms", "recomputed", "ungated"]) -> None:
        """Count a message that was refused, or an output that was alarmed, made again or not judged."""
        self._page[what] += 1

    # -- asking ------------------------------------------------------------------------------------

    def ask(self, key: str, payload: bytes | str, timeout_s: float) -> bytes | None:
        """Ask whoever answers for ``key`` on the bus; None if nobody does in time, or it dies."""
        asked = payload.encode() if isinstance(payload, str) else payload
        answer = self._await(line.ASK, 0, round(timeout_s * 1e9), key.encode() + b"\0" + asked)
        return answer.body if answer.value else None

    def _await(self, kind: int, place: int = 0, first: int = 0, payload: bytes = b"") -> Answer:
        begin = time.perf_counter_ns()
        answer = self._courier.ask(kind, place, first, payload=payload)
        self._page["waiting_wall_ns"] += time.perf_counter_ns() - begin
        return answer

    def _deliver(self, body: bytes) -> None:
        inputs = list(self._inputs.values())
        come: list[list[Stamped]] = [[] for _ in inputs]
        for place, message in line.unpack(body):
            come[place].append(message)
        for one, messages in zip(inputs, come, strict=True):
            one.deliver(messages)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._courier.close()
