"""A node in real time: what is there counts, at the wall-clock time at which it is there.

Same stages, same messages, same loop as in virtual time (``services/bus/node.py``). A stage takes up
the newest trigger as soon as it is free, kernels take as long as they take, the simulator begins its
ticks by the clock. Nobody promises anything before the end. Such a flight does not repeat.
"""

# ruff: noqa: ARG002 - what is overridden keeps its parameters

from __future__ import annotations

import queue
from collections.abc import Iterable

from services.bus.clock import FlightClock
from services.bus.courier import Courier
from services.bus.horizon import NEVER_NS
from services.bus.line import CourierLine, Line
from services.bus.node import Node, NodeSetup
from services.bus.ports import Inlet
from services.bus.session import Meeting
from services.bus.topics import TICK_NS, published_by
from services.bus.vitals import Vitals


class RealtimeNode(Node):
    """A node whose kernels take as long as they take."""

    def __init__(self, setup: NodeSetup, courier: Line, vitals: Vitals, clock: FlightClock) -> None:
        super().__init__(setup, courier, vitals)
        self._clock = clock

    def _elapse(self, kernel: str, invocation: int) -> None:
        self.now_ns = self._clock.now_ns()


class RealtimeCourier(Courier):
    """A courier whose time is the flight's wall clock."""

    def __init__(
        self,
        setup: NodeSetup,
        meeting: Meeting,
        node: CourierLine,
        node_pid: int,
        vitals: Vitals,
        clock: FlightClock,
    ) -> None:
        super().__init__(setup, meeting, node, node_pid, vitals)
        self._clock = clock
        self._owns_clock = published_by(self.name)[0].trigger is None

    def _ready(self, inputs: list[str], watched: list[str], program: int | None = None) -> None:
        """As in virtual time; with everybody there, the simulator lets the time run."""
        super()._ready(inputs, watched, program)
        if self._owns_clock:
            self._clock.begin()

    def promise(self, base_ns: int, busy_until_ns: int) -> None:
        """Only that nothing more follows can be promised."""
        if base_ns >= NEVER_NS:
            super().promise(base_ns, busy_until_ns)

    def _busy_until(self, stage: str, accepted_ns: int) -> int:
        """Nobody knows, so it may be free."""
        return 0

    def _next_start(self, trigger: Inlet, busy_until_ns: int) -> int | None:
        channel = trigger.channel
        self._wait(lambda: channel.head is not None or channel.horizon_ns >= NEVER_NS)
        if channel.head is None:
            self.promise(NEVER_NS, NEVER_NS)
            return None
        return max(self._clock.now_ns(), channel.head.ready_ns)

    def _await_inlets(self, inlets: Iterable[Inlet], now_ns: int) -> None:
        """Take in what has come until the clock shows ``now_ns``: at once for a stage, whose time it is."""
        while not self._inbox.empty():
            self._take_in(*self._inbox.get())
        while (left_ns := now_ns - self._clock.now_ns()) > 0:
            try:
                arrived = self._inbox.get(timeout=left_ns / 1e9)
            except queue.Empty:
                continue
            self._take_in(*arrived)
        if self._owns_clock and left_ns < -TICK_NS:
            self._page["late"] += 1


def join(setup: NodeSetup, courier: Line, vitals: Vitals) -> Node:
    """The node of this process, in the mission's kind of time."""
    if setup.clock is not None:
        return RealtimeNode(setup, courier, vitals, FlightClock(setup.clock))
    return Node(setup, courier, vitals)


def courier(setup: NodeSetup, meeting: Meeting, node: CourierLine, node_pid: int, vitals: Vitals) -> Courier:
    """The courier of a node, in the mission's kind of time."""
    if setup.clock is not None:
        return RealtimeCourier(setup, meeting, node, node_pid, vitals, FlightClock(setup.clock))
    return Courier(setup, meeting, node, node_pid, vitals)
