"""The injector on the bus: a sidecar that knows every node by its announcement and corrupts one."""

from __future__ import annotations

import json
import os
import queue
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import zenoh

from injector.faults.record import record_of
from injector.faults.stopped_thread import InjectionResult
from injector.flight.approach import KernelCall
from injector.flight.external_stage import (
    NeverCalledError,
    StageProbe,
    alike,
    at_the_function,
    draw_site_in_function,
    entry_of,
    programs,
)
from injector.flight.injection import inject
from injector.flight.probe import ProbeLostError, ProbeRun, sent_ahead
from injector.flight.recurring import strike_calls
from injector.flight.site_draw import NothingEligibleError, draw_site
from injector.flight.warm_up import warm_up_on_a_fork
from injector.recurrence.struck_calls import StrikeTally
from injector.tracing.compiled_functions import compiled_functions
from injector.tracing.process import END_LIMIT_MS, Process, ProcessIdentity, VanishedError
from injector.tracing.ptrace import GoneError
from injector.tracing.waiting import hear_of_children
from services.bus import announce, session
from services.bus.announce import Announcement
from services.bus.messages import Injection, encode
from services.bus.session import BusAddress
from services.bus.topics import TOPICS
from services.kernels import aimed_at
from services.models.faults.specification import FaultSpec, Trigger
from services.models.outcome import InjectionRecord
from services.runtime import rng
from services.runtime.clock import FlightClock
from services.runtime.probe_gate import PROBE
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats

MOST_LOST = 5
"""Probes that somebody kills before we give up."""


def warm_up() -> None:
    """Do nothing: no code of the injector is compiled."""


def main(setup: NodeSetup, address: BusAddress, _: SharedStats) -> None:
    """Wait for the armed call, inject once, let everybody pass after that; end with simulator and node."""
    fault = setup.spec.fault
    assert fault is not None  # noqa: S101 - the injector is started with a fault only
    warm_up_on_a_fork(fault)
    hear_of_children()  # before Zenoh has threads: they hold SIGCHLD back, too, and none takes it from us
    with session.open_session(address, setup.name) as bus:
        clock = FlightClock(address.clock) if setup.spec.clock == "realtime" else None
        gate = NodeGate(bus, aimed_at(fault), clock, programs(setup.spec))
        publisher = session.declare_publisher(bus, session.topic_key("injection"))
        token = bus.liveliness().declare_token(announce.announcement(setup.name).key)

        def tell(record: InjectionRecord) -> None:
            text = record.model_dump_json(by_alias=True)
            publisher.put(encode(Injection(record=text), TOPICS["injection"].type))

        if fault.recurs_in_instructions:
            follow_nodes(gate, fault, setup.spec.seed, tell)
        elif gate.wait():
            with suppress(FlightOverError, VanishedError):  # the node may be killed meanwhile
                own = setup.spec.own_stage(aimed_at(fault))
                tell(inject_at(gate, fault, setup.spec.seed, None if own is None else own.function))
            while gate.wait():
                gate.open()
        token.undeclare()  # type: ignore[no-untyped-call]


def follow_nodes(
    gate: NodeGate, fault: FaultSpec, seed: int, tell: Callable[[InjectionRecord], None]
) -> None:
    """Strike the node again and again from its first call at the gate on, and who is started in its place."""
    tally = StrikeTally()
    while gate.wait():
        target, marks = gate.announced[aimed_at(fault)], int(gate.request()["marks"])
        with suppress(VanishedError):  # the node may be killed meanwhile
            strike_calls(target, marks, gate.open, fault, seed, tell, tally)


class ProbeRuns:
    """The probes that the node at the gate, or the program in its place, sends ahead; ``sent`` so far."""

    def __init__(self, gate: NodeGate, target: Announcement, function: str) -> None:
        self._gate, self._target, self._function = gate, target, function
        self.sent = 0

    @contextmanager
    def ahead(self) -> Iterator[ProbeRun]:
        """A probe that the node forks, at the beginning of the call.

        :raises FlightOverError: if the flight ends meanwhile.
        :raises VanishedError: if the node is killed.
        """
        self.sent += 1
        with self._watched(), sent_ahead(self._target, self._gate.send_probe) as probe:
            yield probe
        self.await_node()

    @contextmanager
    def ahead_of_program(self) -> Iterator[StageProbe]:
        """Another process of the program, at the beginning of the call.

        :raises FlightOverError: if the flight ends meanwhile.
        :raises VanishedError: if the node is killed.
        """
        self.sent += 1
        self._gate.send_probe()
        self.await_node()
        program = alike(self._target, int(self._gate.request()["pid"]))
        with self._watched(), at_the_function(program, self._function, self._gate.open) as probe:
            yield probe
        self.await_node()

    def await_node(self) -> None:
        """Wait until the node is at the gate again.

        :raises FlightOverError: if it will not be.
        """
        if not self._gate.wait():
            raise FlightOverError

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """A probe may be killed because its node is.

        :raises VanishedError: if that is so.
        :raises ProbeLostError: if the node lives.
        """
        try:
            yield
        except (GoneError, VanishedError, ProcessLookupError) as error:
            with Process(ProcessIdentity.announced(self._target)) as node:
                if node.ends_within(END_LIMIT_MS):
                    message = f"process {node.pid} is gone"
                    raise VanishedError(message) from error
            raise ProbeLostError("a probe was killed, but not its node") from error


def inject_at(gate: NodeGate, fault: FaultSpec, seed: int, function: str | None) -> InjectionRecord:
    """Inject into the node that is at the gate, while every node stands; probes tell where, if need be.

    ``function`` is that of a program in the stage's place.

    :raises FlightOverError: if the flight ends meanwhile.
    :raises VanishedError: if the node is gone.
    """
    request = gate.request()
    trigger = fault.trigger if fault.trigger is not None else Trigger()
    trigger = trigger.model_copy(update={"invocation": int(request["invocation"])})
    target = gate.announced[aimed_at(fault)]
    probes = ProbeRuns(gate, target, function or "")
    if trigger.site is None and trigger.cpu_ns is None:
        try:
            trigger = _drawn(probes, fault, trigger, seed, function)
        except NothingEligibleError as error:
            return not_injected(gate, fault, trigger, InjectionResult("not_activated", str(error)))
        except NeverCalledError as error:
            return not_injected(gate, fault, trigger, InjectionResult("not_reached", str(error)))
    others = bystanders(gate.announced, target)
    call = KernelCall(
        target,
        int(request["virtual_time_ns"]),
        armed=gate.open,
        finished=gate.is_asked,
        marked=function is None,
        entry=0 if function is None else entry_of(target, function),
        leave_out=gate.leave_out,
        compiled=compiled_functions() if function is None else None,
    )
    record = inject(
        call,
        others,
        fault.model_copy(update={"trigger": trigger}),
        rng.generator(seed, f"injection {fault.target}", fault.seed),
    )
    return record.model_copy(update={"probes": probes.sent})


def bystanders(announced: Mapping[str, Announcement], target: Announcement) -> list[Announcement]:
    """Who is to stand while the target is struck, by the order of names.

    Who is on another host need not, and cannot be told by a pid here, where that is somebody else.
    """
    return [
        one
        for _, one in sorted(announced.items())
        if one.boot_id == target.boot_id and one.pid not in (target.pid, os.getpid())
    ]


def _drawn(probes: ProbeRuns, fault: FaultSpec, trigger: Trigger, seed: int, function: str | None) -> Trigger:
    """The trigger with a site; drawn anew, and so the same, if somebody kills a probe.

    :raises ProbeLostError: if that happens again and again.
    """
    lost = 0
    while True:
        draw = rng.generator(seed, f"site {fault.target}", fault.seed)
        try:
            if function is None:
                return draw_site(probes.ahead, fault, trigger, draw)
            return draw_site_in_function(probes.ahead_of_program, trigger, draw)
        except ProbeLostError:
            lost += 1
            if lost == MOST_LOST:
                raise
            probes.await_node()


def not_injected(
    gate: NodeGate, fault: FaultSpec, trigger: Trigger, result: InjectionResult
) -> InjectionRecord:
    """The record of a call in which there is nothing to strike, and which goes on as it is."""
    if not gate.wait():
        raise FlightOverError
    gate.open()
    return record_of(
        result,
        fault,
        node=aimed_at(fault),
        kernel=fault.target,
        invocation=trigger.invocation or 0,
        trigger=trigger,
    )


class FlightOverError(Exception):
    """The simulator and the node have left the bus: the flight is over."""


class NodeGate:
    """Where the armed node waits, and who is there. Zenoh's threads only fill the queue.

    ``programs`` are what is run in the place of stages.
    """

    def __init__(
        self,
        bus: zenoh.Session,
        stage: str,
        clock: FlightClock | None,
        programs: Mapping[str, tuple[int, int]],
    ) -> None:
        self._clock = clock
        self._programs = programs
        self._over = self._sim_left = False
        self._stage = stage
        self.announced: dict[str, Announcement] = {}
        self._waiting: zenoh.Query | None = None
        self._key = session.gate_key(stage)
        self._events: queue.SimpleQueue[tuple[Callable[[Any], bool], Any]] = queue.SimpleQueue()
        self._declared = (
            bus.declare_queryable(
                self._key, session.hand_over(lambda query: self._events.put((_is_query, query)))
            ),
            bus.liveliness().declare_subscriber(
                announce.ALL,
                session.hand_over(lambda sample: self._events.put((self._meet, sample))),
                history=True,
            ),
        )

    def leave_out(self, pause_ns: int) -> None:
        """Keep a pause out of the time of a flight in real time; virtual time stands still anyway."""
        if self._clock is not None:
            self._clock.leave_out(pause_ns)

    def wait(self) -> bool:
        """Wait until the node is at the gate and known; False once the simulator and the node are gone."""
        while not self._is_there() and not self._over:
            self._take_in()
        return self._is_there()

    def _is_there(self) -> bool:
        return self._waiting is not None and self._stage in self.announced

    def is_asked(self) -> bool:
        """Whether the node is at the gate again, or the flight over: its call is."""
        while self._waiting is None and not self._over and not self._events.empty():
            self._take_in()
        return self._waiting is not None or self._over

    def _take_in(self) -> None:
        handle, event = self._events.get()
        if handle(event):
            if handle is _is_query:
                self._waiting = event
            else:
                self._over = True

    def request(self) -> dict[str, Any]:
        """What the node at the gate says of its call."""
        payload = self._waiting.payload if self._waiting is not None else None
        return dict(json.loads(payload.to_bytes())) if payload is not None else {}

    def open(self) -> None:
        """Let the node that waits at the gate go on."""
        self._answer(b"")

    def send_probe(self) -> None:
        """Have the node send a probe through the gate, after which it will be there again."""
        self._answer(PROBE)

    def _answer(self, payload: bytes) -> None:
        if self._waiting is not None:
            with self._waiting as query:
                query.reply(self._key, payload)
            self._waiting = None

    def _meet(self, sample: zenoh.Sample) -> bool:
        """Note who came or went; whether the flight is over by that.

        The simulator may have flown to the end before the armed call, as it knows when each answer is due.
        """
        one = Announcement.parse(str(sample.key_expr))
        if sample.kind == zenoh.SampleKind.PUT:
            self.announced[one.name] = replace(one, executable=self._programs.get(one.name))
            return False
        known = self.announced.get(one.name)
        if known is not None and replace(known, executable=None) == replace(one, executable=None):
            del self.announced[one.name]
        self._sim_left = self._sim_left or one.name == "sim"
        return self._sim_left and self._stage not in self.announced


def _is_query(_: zenoh.Query) -> bool:
    return True
