"""How often a call executes the instructions that lie in a fault's scope, and which of them it can strike.

By the law of the draw (docs/internals/sampling.md) each eligible dynamic instruction is equally likely.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property

import numpy as np

from injector.block_profile.counted_call import CountedCall
from injector.block_profile.instruction_counts import (
    DynamicInstruction,
    InstructionCounts,
    draw_instruction,
)
from injector.faults.code_scope import countable_code
from injector.faults.eligibility import is_eligible
from injector.isa.host import decode
from injector.isa.instruction import DecodeError
from injector.tracing.compiled_functions import CompiledFunctions
from injector.tracing.elf import CodeLocations
from injector.tracing.process import Process
from injector.tracing.tracee import Tracee
from services.models.faults.specification import FaultSpec


def counted_call(
    thread: Tracee,
    process: Process,
    fault: FaultSpec,
    *,
    leaders: Collection[int] = frozenset(),
    stops: Mapping[int, Sequence[int]] | None = None,
) -> CountedCall:
    """The call at whose beginning a copy stands, counted in the code of the fault's scope.

    :raises UncountableError: if there is no room for translations.
    """
    return CountedCall(thread, process, countable_code(fault, process), leaders=leaders, stops=stops)


class CallProfile:
    """The counts of one call in a fault's scope. Making one runs the copy to the call's end."""

    def __init__(
        self, thread: Tracee, process: Process, fault: FaultSpec, mark: int, compiled: CompiledFunctions
    ) -> None:
        """Count; the signal ``mark`` tells the call's end.

        :raises UncountableError: if the call does not come to its end in translation.
        :raises GoneError: if somebody kills the copy.
        """
        self._fault = fault
        self._call = counted_call(thread, process, fault)
        blocks = self._call.run(mark)
        self.places = CodeLocations(process.pid, process.maps(), compiled)
        # By names and offsets, not by addresses: the draw is the same where memory lies elsewhere.
        self.counts = InstructionCounts.of(blocks, order=self.places.named)

    def is_eligible(self, address: int) -> bool:
        """Whether the fault can strike the instruction at an address in its scope."""
        try:
            return is_eligible(self._fault, decode(self._call.code_at(address), address))
        except DecodeError:
            return False

    def draw(self, draw: np.random.Generator) -> DynamicInstruction | None:
        """Draw one of the dynamic instructions that the fault can strike, all alike; None: there is none."""
        return draw_instruction(self.counts, self.is_eligible, draw)

    @cached_property
    def eligible(self) -> InstructionCounts:
        """The counts of what the fault can strike alone: to draw many from."""
        return self.counts.only(self.is_eligible)
