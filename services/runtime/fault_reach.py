"""Whether the mission's fault may strike what a node makes next: what it cannot reach is not made twice."""

from __future__ import annotations

from collections.abc import Mapping

from services.runtime.kernel_timer import KernelTimer
from services.runtime.source_fault import SourceFault


class FaultReach:
    """The reach of the mission's fault: kernel calls of one node and the messages that it publishes.

    ``published`` counts the node's messages by topic; it is looked at when asked.
    """

    def __init__(self, timer: KernelTimer, fault: SourceFault | None, published: Mapping[str, int]) -> None:
        self._timer = timer
        self._fault = fault
        self._published = published

    def covers_next(self, now_ns: int) -> bool:
        """Whether the fault may strike the output that the node makes from ``now_ns`` on."""
        fault = self._fault
        if fault is not None and fault.topic in self._published:
            return fault.may_strike(self._published[fault.topic], now_ns)
        return self._timer.may_be_struck(now_ns)

    @property
    def strikes(self) -> int:
        """How many kernel calls and messages the fault was let at."""
        return self._timer.armed_calls + (self._fault.strikes if self._fault is not None else 0)
