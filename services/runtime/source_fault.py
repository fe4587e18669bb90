"""Source-level faults: bits of an inter-kernel state, in one message, where the stage publishes it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from services.models.faults.arithmetic import draw_bits, groups, struck
from services.models.faults.specification import FaultSpec
from services.models.inter_kernel_states import InterKernelState, members
from services.models.outcome import InjectionRecord
from services.runtime import rng


class SourceFault:
    """One fault: in the message of its topic that the trigger names, counted from 0, or as it recurs.

    It is asked about each message of the topic, by a stage that began at virtual time ``start_ns``.
    ``strikes`` counts.
    """

    def __init__(self, fault: FaultSpec, mission_seed: int, start_ns: int = 0) -> None:
        self._fault = fault
        self._states = members(fault.target)
        self.topic = self._states[0].topic
        self._seed = mission_seed
        self._done = False
        self.strikes = 0
        self._number, self._again = -1, 0
        self._upsets = _upsets(fault, mission_seed, start_ns) if fault.rate_hz is not None else iter(())
        self._next_upset_ns = next(self._upsets, math.inf)

    def may_strike(self, number: int, now_ns: int) -> bool:
        """Whether it may strike the ``number``-th message of its topic, which is made from ``now_ns`` on."""
        fault, trigger = self._fault, self._fault.trigger
        if fault.recurrence != "once":
            return fault.until_s is None or now_ns < fault.until_s * 1e9
        if self._done or trigger is None:
            return False
        return trigger.invocation in (None, number)

    def strike(self, message: Any, number: int, now_ns: int) -> list[InjectionRecord]:
        """Corrupt ``message``, the ``number``-th of its topic, as often as it is due: what was done then."""
        trigger = self._fault.trigger
        if self._fault.recurrence == "once" and trigger is not None:
            trigger = trigger.model_copy(update={"invocation": number})
        told = {"invocation": number, "virtual_time_ns": now_ns, "trigger": trigger}
        done = [self._struck(message, draw).model_copy(update=told) for draw in self._draws(number, now_ns)]
        self.strikes += len(done)
        return done

    def _draws(self, number: int, now_ns: int) -> Iterator[np.random.Generator]:
        """For each time that a message is struck, what its bits are drawn from."""
        fault, purpose = self._fault, f"source {self._fault.target}"
        if fault.recurrence == "once":
            if not self._done and fault.trigger is not None and fault.trigger.names(number, now_ns):
                self._done = True
                yield rng.generator(self._seed, purpose, fault.seed)
            return
        until_s = math.inf if fault.until_s is None else fault.until_s
        if not fault.from_s * 1e9 <= now_ns < until_s * 1e9:
            return
        if fault.recurrence == "permanent":
            yield rng.generator(self._seed, purpose, fault.seed)
        elif fault.probability is not None:
            # What is made again is another message: its own chance.
            self._again = self._again + 1 if number == self._number else 0
            self._number = number
            draw = rng.generator(self._seed, purpose, fault.seed, number, self._again)
            if draw.random() < fault.probability:
                yield draw
        while self._next_upset_ns <= now_ns:
            yield rng.generator(self._seed, purpose, fault.seed, int(self._next_upset_ns))
            self._next_upset_ns = next(self._upsets, math.inf)

    def _struck(self, message: Any, draw: np.random.Generator) -> InjectionRecord:
        fault = self._fault
        states: Sequence[InterKernelState] = self._states
        if fault.components == "one":
            states = (states[int(draw.integers(len(states)))],)
        points = len(states[0].values(message))
        if points <= (fault.point or 0):
            reason = f"the message has {points} points"
            return self._record(status="not_activated", reason=reason)
        point = int(draw.integers(points)) if fault.point is None else fault.point
        parts = [self._change(state, message, point, draw) for state in states]
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

    def _change(
        self, state: InterKernelState, message: Any, point: int, draw: np.random.Generator
    ) -> _Changed:
        values = state.values(message)
        bits = draw_bits(self._fault, eligible(self._fault, state), draw)
        before = _as_integer(values[point])
        after = struck(self._fault, before, bits)
        values[point] = np.frombuffer(after.to_bytes(values.itemsize, "little"), dtype=state.dtype)[0]
        state.put(message, values)
        return _Changed((before, after, _as_integer(state.values(message)[point])), bits)

    def _record(self, **found: Any) -> InjectionRecord:
        node, model = self._states[0].stage, self._fault.model
        return InjectionRecord(precision="exact", node=node, kernel="", invocation=0, model=model, **found)


def _upsets(fault: FaultSpec, mission_seed: int, start_ns: int) -> Iterator[float]:
    """The times, ns, of a Poisson process from the fault's ``from_s`` on: those after ``start_ns``."""
    assert fault.rate_hz is not None  # noqa: S101 - asked for with a rate only
    draw = rng.generator(mission_seed, f"upsets {fault.target}", fault.seed)
    at_ns = fault.from_s * 1e9
    while True:
        at_ns += draw.exponential(1e9 / fault.rate_hz)
        if at_ns > start_ns:
            yield at_ns


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
