"""Nodes in real time: messages count as they arrive, at the wall-clock time of their arrival.

Same stages, same messages, same loop as in virtual time (``services/runtime/node.py``). A stage takes up
the newest trigger as soon as it is free, kernels take as long as they take, the simulator begins its
ticks by the clock. Nobody promises anything before the end. Such a flight does not repeat.
"""

# ruff: noqa: ARG002 - what is overridden keeps its parameters

from __future__ import annotations

from collections.abc import Iterable

from services.bus.horizon import NEVER_NS
from services.bus.ports import Inlet
from services.bus.proxy_link import NodeLink, ProxyLink
from services.bus.session import BusAddress
from services.bus.topics import TICK_NS, published_by
from services.runtime.bus_proxy import BusProxy
from services.runtime.clock import FlightClock
from services.runtime.kernel_timer import KernelTimer
from services.runtime.node import Node
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats


class RealtimeTimer(KernelTimer):
    """Kernel calls that take as long as they take on this machine."""

    def __init__(self, setup: NodeSetup, proxy: NodeLink, stats: SharedStats, clock: FlightClock) -> None:
        super().__init__(setup, proxy, stats.page)
        self._clock = clock

    def end_ns(self, now_ns: int, kernel: str, invocation: int) -> int:
        """The end of a call: the time that the flight's clock shows."""
        return self._clock.now_ns()


class RealtimeBusProxy(BusProxy):
    """A proxy whose time is the flight's wall clock."""

    def __init__(
        self,
        setup: NodeSetup,
        address: BusAddress,
        node: ProxyLink,
        node_pid: int,
        stats: SharedStats,
        clock: FlightClock,
    ) -> None:
        super().__init__(setup, address, node, node_pid, stats)
        self._clock = clock
        self._carrier = ""  # no promise follows a message
        self._owns_clock = published_by(self.name)[0].trigger is None

    def _ready(self, inputs: list[str], watched: list[str], program: int | None = None) -> None:
        """Announce the node as in virtual time; once all nodes are there, the simulator starts the clock."""
        super()._ready(inputs, watched, program)
        if self._owns_clock:
            self._clock.begin()

    def promise(self, base_ns: int, busy_until_ns: int) -> None:
        """Publish only the last promise: in real time nothing else can be promised."""
        if base_ns >= NEVER_NS:
            super().promise(base_ns, busy_until_ns)

    def _busy_until(self, stage: str, accepted_ns: int) -> int:
        """In real time no stage can be known to be busy, so it counts as free."""
        return 0

    def _next_start(self, trigger: Inlet, busy_until_ns: int) -> int | None:
        channel = trigger.channel
        self._listener.wait(lambda: channel.head is not None or channel.horizon_ns >= NEVER_NS)
        if channel.head is None:
            self.promise(NEVER_NS, NEVER_NS)
            return None
        return max(self._clock.now_ns(), channel.head.ready_ns)

    def _await_inlets(self, inlets: Iterable[Inlet], now_ns: int) -> None:
        """Take in what has come until the clock shows ``now_ns``: at once for a stage, whose time it is."""
        self._listener.take_in_arrived()
        while (left_ns := now_ns - self._clock.now_ns()) > 0:
            self._listener.take_in(left_ns / 1e9)
        if self._owns_clock and left_ns < -TICK_NS:
            self._page["late"] += 1


def join(setup: NodeSetup, proxy: NodeLink, stats: SharedStats) -> Node:
    """The stage's node in this process, in the mission's kind of time."""
    if setup.clock is not None:
        return Node(setup, proxy, stats, RealtimeTimer(setup, proxy, stats, FlightClock(setup.clock)))
    return Node(setup, proxy, stats)


def proxy(
    setup: NodeSetup, address: BusAddress, node: ProxyLink, node_pid: int, stats: SharedStats
) -> BusProxy:
    """The proxy of a node, in the mission's kind of time."""
    if setup.clock is not None:
        return RealtimeBusProxy(setup, address, node, node_pid, stats, FlightClock(setup.clock))
    return BusProxy(setup, address, node, node_pid, stats)
