"""How often a call executes each of its instructions; one of them drawn, and a quick way to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from injector.block_profile.counted_call import BlockCounts


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
        cls, blocks: BlockCounts, order: Callable[[int], Any] = lambda address: address
    ) -> InstructionCounts:
        """Sum up what blocks were passed; an instruction may lie in several. Addresses are put in order."""
        passes: dict[int, int] = {}
        leaders = set()
        for instructions, often in zip(blocks.instructions, blocks.passes.tolist(), strict=True):
            if often:
                leaders.add(instructions[0])
            for address in instructions if often else ():
                passes[address] = passes.get(address, 0) + often
        addresses = sorted(passes, key=order)
        return cls(
            np.array(addresses, np.uint64),
            np.array([passes[address] for address in addresses], np.int64),
            frozenset(leaders),
        )

    def only(self, is_eligible: Callable[[int], bool]) -> InstructionCounts:
        """The same of those instructions alone that are eligible."""
        kept = np.array([is_eligible(int(address)) for address in self.addresses], bool)
        return InstructionCounts(self.addresses[kept], self.passes[kept], self.leaders)

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
    """A way to a dynamic instruction: to the ``hit``-th pass through ``address``, then ``rest`` passes on.

    Passes are counted from where one stands, that one not included.
    """

    address: int
    hit: int
    rest: int


FEW_PASSES = 2_000
"""Passes through an address that are counted from the call's beginning: some 20 ms."""


def way_from_the_beginning(
    blocks: BlockCounts, target: DynamicInstruction, before: BlockCounts | None = None
) -> Way | None:
    """A quicker way to a late pass than to count all of them; None: there is none, or it is early.

    ``blocks`` are of a copy that stands before the target, and noted its passes since ``before``.
    """
    if target.hit <= FEW_PASSES:
        return None
    return _cheapest(blocks, target, blocks.passes - _earlier(blocks, before) > 0, blocks.passes, target.hit)


def shortest_way(
    blocks: BlockCounts, target: DynamicInstruction, before: BlockCounts | None = None
) -> Way | None:
    """The way with the fewest passes to count; None if none is shorter than to count all of the target's.

    ``blocks`` are of a copy that stands before the target and noted its passes; ``before`` tells of the same
    copy where the way begins, without it at the beginning of the call.
    """
    earlier = _earlier(blocks, before)
    passes = blocks.passes - earlier
    direct = target.hit - int(earlier[blocks.leaders == target.address].sum())
    return _cheapest(blocks, target, passes > 0, passes, direct)


def _earlier(blocks: BlockCounts, before: BlockCounts | None) -> NDArray[np.int64]:
    earlier = np.zeros_like(blocks.passes)
    if before is not None:
        earlier[: len(before.passes)] = before.passes
    return earlier


def _cheapest(
    blocks: BlockCounts,
    target: DynamicInstruction,
    noted: NDArray[np.bool_],
    passes: NDArray[np.int64],
    direct: int,
) -> Way | None:
    """The way through one of the blocks at which passes were ``noted``, if it is cheaper than directly."""
    possible = np.flatnonzero(noted & (blocks.leaders != target.address))
    costs = (passes + target.hit - blocks.noted)[possible]
    if not len(possible) or int(costs.min()) >= direct:
        return None
    cheapest = possible[costs == costs.min()]
    best = int(cheapest[np.argmin(blocks.leaders[cheapest])])
    return Way(int(blocks.leaders[best]), int(passes[best]), target.hit - int(blocks.noted[best]))
