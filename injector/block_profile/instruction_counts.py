"""How often a call executes each of its instructions; one of them drawn, and a quick way to it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from injector.block_profile.counted_call import CountedBlock


@dataclass(frozen=True, slots=True)
class InstructionCounts:
    """The instructions that a call executes: their ``addresses``, and how often it ``passes`` each.

    ``leaders`` are where blocks begin.
    """

    addresses: NDArray[np.uint64]
    passes: NDArray[np.int64]
    leaders: frozenset[int]

    @classmethod
    def of(
        cls, blocks: Iterable[CountedBlock], order: Callable[[int], Any] = lambda address: address
    ) -> InstructionCounts:
        """Sum up what blocks were passed; an instruction may lie in several. Addresses are put in order."""
        passes: dict[int, int] = {}
        leaders = set()
        for block in blocks:
            if block.passes:
                leaders.add(block.instructions[0])
            for address in block.instructions if block.passes else ():
                passes[address] = passes.get(address, 0) + block.passes
        addresses = sorted(passes, key=order)
        return cls(
            np.array(addresses, np.uint64),
            np.array([passes[address] for address in addresses], np.int64),
            frozenset(leaders),
        )

    @property
    def executed(self) -> int:
        """How many instructions the call executes; a repeated one counts once."""
        return int(self.passes.sum())


@dataclass(frozen=True, slots=True)
class DynamicInstruction:
    """The ``hit``-th of a call's ``passes`` passes through an address."""

    address: int
    hit: int
    passes: int


def draw_instruction(
    counts: InstructionCounts, is_eligible: Callable[[int], bool], draw: np.random.Generator
) -> DynamicInstruction | None:
    """Draw one of a call's eligible dynamic instructions, all alike; None if there is none.

    An address that turns out not to be eligible is left out, and another one drawn: of those that are left,
    each is as likely as its passes say.
    """
    passes = counts.passes.copy()
    while total := int(passes.sum()):
        index = int(np.searchsorted(np.cumsum(passes), draw.integers(total), side="right"))
        address = int(counts.addresses[index])
        if is_eligible(address):
            often = int(passes[index])
            return DynamicInstruction(address, 1 + int(draw.integers(often)), often)
        passes[index] = 0
    return None


@dataclass(frozen=True, slots=True)
class Way:
    """A way to a dynamic instruction: to the ``hit``-th pass through ``address``, then ``rest`` passes on."""

    address: int
    hit: int
    rest: int


def shortest_way(blocks: Sequence[CountedBlock], target: DynamicInstruction) -> Way | None:
    """The way with the fewest passes to count; None if none is shorter than to count all of the target's.

    ``blocks`` are of a copy that stands before the target and noted its passes.
    """
    ways = [
        Way(one.instructions[0], one.passes, target.hit - one.noted)
        for one in blocks
        if one.passes and one.instructions[0] != target.address
    ]
    best = min(ways, key=lambda way: (way.hit + way.rest, way.address), default=None)
    return best if best is not None and best.hit + best.rest < target.hit else None
