"""Calls of a kernel that a fault strikes again and again: told to the injector by signals to ourselves.

Only the first is held at the gate, where the injector seizes the node. It traces the node from then on, so a
signal is enough; the numbers that say which call it is lie where the injector reads them.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from services.models.fault_spec import FaultSpec

GATE_SIGNAL = signal.SIGURG
"""Marks the beginning and the end of an armed call to the tracer; ignored by default."""

OUTSIDE, WITHIN = 0, 1
"""The first of the numbers that describe a call: whether it is under way."""

MARKS = 4
"""Numbers that describe a call: whether it is under way, its invocation, its beginning and its end, ns."""


class MarkedCalls:
    """Marks those calls of a node that begin while a fault recurs."""

    def __init__(self, fault: FaultSpec) -> None:
        self._target = fault.target
        self._from_ns = fault.from_s * 1e9
        self._until_ns = math.inf if fault.until_s is None else fault.until_s * 1e9
        self._marks = np.zeros(MARKS, np.int64)
        self._traced = False

    def include(self, kernel: str, now_ns: int) -> bool:
        """Whether a call that begins now is one of them."""
        return kernel == self._target and self._from_ns <= now_ns < self._until_ns

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
