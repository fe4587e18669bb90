"""Source-level faults: bits of an inter-kernel state, in one message, where the stage publishes it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from services.models.fault_model import draw_bits, groups, struck
from services.models.inter_kernel_states import InterKernelState, members
from services.models.mission import FaultSpec
from services.models.outcome import InjectionRecord
from services.runtime import rng


class SourceFault:
    """One fault, once: in the message of its topic that the trigger names, counted from 0."""

    def __init__(self, fault: FaultSpec, mission_seed: int) -> None:
        self._fault = fault
        self._states = members(fault.target)
        self.topic = self._states[0].topic
        self._draw = rng.generator(mission_seed, f"source {fault.target}", fault.seed)
        self._done = False

    def strike(self, message: Any, number: int, now_ns: int) -> InjectionRecord | None:
        """Corrupt ``message``, the ``number``-th of its topic, if it is the one: what was done then."""
        trigger = self._fault.trigger
        if self._done or trigger is None or not trigger.names(number, now_ns):
            return None
        self._done = True
        again = trigger.model_copy(update={"invocation": number})
        return self._struck(message).model_copy(
            update={"invocation": number, "virtual_time_ns": now_ns, "trigger": again}
        )

    def _struck(self, message: Any) -> InjectionRecord:
        fault, draw = self._fault, self._draw
        states: Sequence[InterKernelState] = self._states
        if fault.components == "one":
            states = (states[int(draw.integers(len(states)))],)
        points = len(states[0].values(message))
        if points <= (fault.point or 0):
            reason = f"the message has {points} points"
            return self._record(status="not_activated", reason=reason)
        point = int(draw.integers(points)) if fault.point is None else fault.point
        parts = [self._change(state, message, point) for state in states]
        width = states[0].width_bits
        before, after, read_back = (
            "".join(f"{number:0{width // 4}x}" for number in reversed(numbers))
            for numbers in zip(*(part.numbers for part in parts), strict=True)
        )
        done = read_back == after
        return self._record(
            status="failed" if not done else "not_activated" if fault.model == "none" else "injected",
            reason="" if done else "the message did not take the change",
            state=[state.name for state in states],
            point=point,
            width_bits=width * len(parts),
            element_bits=width if states[0].floating else 0,
            bits=[width * place + bit for place, part in enumerate(parts) for bit in part.bits],
            before=before,
            after=after,
            read_back=read_back,
        )

    def _change(self, state: InterKernelState, message: Any, point: int) -> _Changed:
        values = state.values(message)
        bits = draw_bits(self._fault, eligible(self._fault, state), self._draw)
        before = _as_integer(values[point])
        after = struck(self._fault, before, bits)
        values[point] = np.frombuffer(after.to_bytes(values.itemsize, "little"), dtype=state.dtype)[0]
        state.put(message, values)
        return _Changed((before, after, _as_integer(state.values(message)[point])), bits)

    def _record(self, **found: Any) -> InjectionRecord:
        node, model = self._states[0].stage, self._fault.model
        return InjectionRecord(precision="exact", node=node, kernel="", invocation=0, model=model, **found)


def eligible(fault: FaultSpec, state: InterKernelState) -> list[Sequence[int]]:
    """The sets of bits of one value that the fault draws from; empty if it has none such."""
    width = state.width_bits
    return groups(fault, width, width if state.floating else 0)


class _Changed(NamedTuple):
    """What became of one number: what it was, was to be and is, as integers; the bits."""

    numbers: tuple[int, int, int]
    bits: tuple[int, ...]


def _as_integer(number: Any) -> int:
    return int.from_bytes(number.tobytes(), "little")
