"""Kernel calls of a node: counted, timed, stopped at the injector's gate if armed; they take virtual time."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import MappingProxyType
from typing import Protocol

import numpy as np

from services.bus import proxy_link, session
from services.bus.proxy_link import NodeLink
from services.models.faults.specification import FaultSpec
from services.runtime.latency import Latency
from services.runtime.probe_gate import stand_at_gate
from services.runtime.setup import NodeSetup
from services.system.stopwatch import KernelStopwatch

GATE_TIMEOUT_S = 60.0

GATE_SIGNAL = signal.SIGURG
"""Marks the beginning and the end of an armed call to the tracer; ignored by default."""

OUTSIDE, WITHIN = 0, 1
"""The first of the numbers that describe a call: whether it is under way."""

MOST_CALLS = 8
"""A node calls a kernel less often than that for one output."""

MARKS = 4
"""Numbers that describe a call: whether it is under way, its invocation, its beginning and its end, ns."""

NOTHING_MORE: Mapping[str, int] = MappingProxyType({})


class TimedNode(Protocol):
    """A node whose virtual time passes with its kernel calls."""

    now_ns: int


class KernelTimer:
    """Runs the kernel calls of one node and lets the time pass that they take on the mission's platform."""

    def __init__(
        self, setup: NodeSetup, proxy: NodeLink, page: np.void, cpu: KernelStopwatch | None = None
    ) -> None:
        self._name = setup.name
        self._kernels = setup.kernels
        self._proxy = proxy
        self._page = page
        self._page["gated"] = 0
        self._cpu = KernelStopwatch(page, time.CLOCK_THREAD_CPUTIME_ID) if cpu is None else cpu
        fault = setup.spec.fault
        recurs = fault is not None and fault.recurs_in_instructions
        self._fault = None if recurs else fault
        self._marked = MarkedCalls(fault) if fault is not None and recurs else None
        self.armed_calls = 0
        """How many calls the injector was told of."""
        self._latencies: Mapping[str, Latency] = {
            kernel: Latency(stated, setup.spec.seed, kernel, setup.life)
            for kernel, stated in setup.latencies.items()
        }

    @contextmanager
    def call(self, kernel: str, node: TimedNode) -> Iterator[None]:
        """Run a kernel's call as the body of a ``with`` statement; ``node.now_ns`` is then its end.

        What was published before goes out: it does not depend on what becomes of us.
        """
        self._proxy.send()
        page, index = self._page, self._kernels.index(kernel)
        invocation = int(page["invocations"][index])
        # Before the call: one that ends in a crash is not to be armed again after the restart.
        page["invocations"][index] += 1
        page["end_ns"][index] = end_ns = self.end_ns(node.now_ns, kernel, invocation)
        armed = self._is_armed(kernel, invocation, node.now_ns)
        in_probe = armed and self._gate("enter", kernel, invocation, node.now_ns)
        self._cpu.restart()
        if armed:
            signal.raise_signal(GATE_SIGNAL)
        try:
            with self._mark(kernel, invocation, node.now_ns, end_ns):
                yield
        finally:
            if in_probe:
                signal.raise_signal(GATE_SIGNAL)
                os._exit(0)
        if armed:
            signal.raise_signal(GATE_SIGNAL)
        self._cpu.lap(index)
        if armed:
            self._gate("leave", kernel, invocation, node.now_ns)
        node.now_ns = end_ns

    def may_be_struck(self, now_ns: int) -> bool:
        """Whether the fault may strike one of the next ``MOST_CALLS`` calls of a kernel, now or later."""
        if self._marked is not None:
            return self._marked.target in self._kernels and now_ns < self._marked.until_ns
        fault, page = self._fault, self._page
        if fault is None or fault.level != "instruction" or fault.target not in self._kernels:
            return False
        calls = page["invocations"][self._kernels.index(fault.target)]
        return bool(page["armed_from_ns"] >= 0 or calls <= page["armed_invocation"] < calls + MOST_CALLS)

    def become_copy(self, proxy: NodeLink, page: np.void) -> None:
        """Count on another page from now on, and stand at no gate: this is a fork of the node."""
        self._proxy, self._page = proxy, page
        self._cpu = KernelStopwatch(page, time.CLOCK_THREAD_CPUTIME_ID)
        self._fault = self._marked = None

    def end_ns(self, now_ns: int, kernel: str, invocation: int) -> int:
        """The time at which a call that began at ``now_ns`` ends on the mission's platform."""
        return now_ns + self._latencies[kernel].of(invocation)

    def latency(self, kernel: str) -> Latency:
        """The latency of a kernel on the mission's platform."""
        return self._latencies[kernel]

    def _is_armed(self, kernel: str, invocation: int, now_ns: int) -> bool:
        """Whether this call is the one that the fault is for; at most one is between two restarts."""
        fault, page = self._fault, self._page
        if fault is None or fault.level != "instruction" or fault.target != kernel:
            return False
        if not (page["armed_invocation"] == invocation or 0 <= page["armed_from_ns"] <= now_ns):
            return False
        self._fault = None
        self.armed_calls += 1
        return True

    def _mark(self, kernel: str, invocation: int, now_ns: int, end_ns: int) -> AbstractContextManager[None]:
        """Tell the injector of the call if the fault strikes it and others."""
        if self._marked is None or not self._marked.include(kernel, now_ns):
            return nullcontext()
        self.armed_calls += 1
        return self._marked.call(
            invocation, now_ns, end_ns, lambda more: self._gate("enter", kernel, invocation, now_ns, more)
        )

    def _gate(
        self, phase: str, kernel: str, invocation: int, now_ns: int, more: Mapping[str, int] = NOTHING_MORE
    ) -> bool:
        """Let the injector seize or detach from this process; True in a probe that it sends ahead.

        While it has, a signal to ourselves marks where the call begins and ends: the tracer sees it and
        takes it away, and without a tracer it is ignored.
        """
        request = json.dumps(
            {"phase": phase, "kernel": kernel, "invocation": invocation, "virtual_time_ns": now_ns, **more}
        )
        self._page["gated"] = 1
        if self._stand_at_gate(session.gate_key(self._name), request):
            return True
        self._page["gated"] = 0
        return False

    def _stand_at_gate(self, key: str, request: str) -> bool:
        """Ask at the gate until it opens; True in a probe that is sent ahead."""
        return stand_at_gate(self._proxy, proxy_link.question(key, request.encode(), GATE_TIMEOUT_S))


class MarkedCalls:
    """Calls of a kernel that a fault strikes again and again: told to the injector by signals to ourselves.

    Only the first is held at the gate, where the injector seizes the node. It traces the node from then on,
    so a signal is enough; the numbers that say which call it is lie where the injector reads them.
    """

    def __init__(self, fault: FaultSpec) -> None:
        self.target = fault.target
        self._from_ns = fault.from_s * 1e9
        self.until_ns = math.inf if fault.until_s is None else fault.until_s * 1e9
        self._marks = np.zeros(MARKS, np.int64)
        self._traced = False

    def include(self, kernel: str, now_ns: int) -> bool:
        """Whether a call that begins now is one of them."""
        return kernel == self.target and self._from_ns <= now_ns < self.until_ns

    @contextmanager
    def call(
        self, invocation: int, now_ns: int, end_ns: int, enter: Callable[[dict[str, int]], object]
    ) -> Iterator[None]:
        """Run a call as the body of a ``with`` statement; ``enter`` stands at the gate before the first."""
        if not self._traced:
            self._traced = True
            enter({"marks": self._marks.ctypes.data})
        self._marks[:] = WITHIN, invocation, now_ns, end_ns
        signal.raise_signal(GATE_SIGNAL)
        try:
            yield
        finally:
            self._marks[0] = OUTSIDE
            signal.raise_signal(GATE_SIGNAL)
