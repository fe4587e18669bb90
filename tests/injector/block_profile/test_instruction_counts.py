"""The law of the draw, and the shortest way to what was drawn."""

from collections import Counter

import numpy as np
import pytest
from scipy.stats import chisquare

from injector.block_profile.counted_call import BlockCounts
from injector.block_profile.instruction_counts import (
    DynamicInstruction,
    InstructionCounts,
    Way,
    draw_instruction,
    shortest_way,
)

pytestmark = pytest.mark.unit


def blocks(*those: tuple[tuple[int, ...], int, int]) -> BlockCounts:
    """Each by its instructions, its passes, and what it noted."""
    leaders = np.array([instructions[0] for instructions, _, _ in those], np.uint64)
    passes, noted = (np.array([one[at] for one in those], np.int64) for at in (1, 2))
    return BlockCounts(tuple(instructions for instructions, _, _ in those), leaders, passes, noted)


BLOCKS = blocks(((16, 18, 24), 7, 0), ((40, 44), 3, 0), ((18, 24), 5, 0), ((60,), 0, 0))
PASSES = {16: 7, 18: 12, 24: 12, 40: 3, 44: 3}


def test_an_instruction_of_several_blocks_is_passed_in_each() -> None:
    counts = InstructionCounts.of(BLOCKS)
    assert dict(zip(counts.addresses.tolist(), counts.passes.tolist(), strict=True)) == PASSES
    assert counts.executed == sum(PASSES.values())
    assert counts.leaders == {16, 40, 18}


@pytest.mark.parametrize("eligible", [set(PASSES), {18, 40}, {44}])
def test_eligible_instructions_are_drawn_alike_and_no_others(eligible: set[int]) -> None:
    counts, draw = InstructionCounts.of(BLOCKS), np.random.default_rng(1)
    drawn: Counter[tuple[int, int]] = Counter()
    for _ in range(3000):
        found = draw_instruction(counts, eligible.__contains__, draw)
        assert found is not None
        assert found.passes == PASSES[found.address]
        drawn[found.address, found.hit] += 1
    alike = [(address, 1 + one) for address in sorted(eligible) for one in range(PASSES[address])]
    assert set(drawn) == set(alike)
    assert chisquare([drawn[one] for one in alike]).pvalue > 0.01


def test_of_nothing_eligible_nothing_is_drawn() -> None:
    assert draw_instruction(InstructionCounts.of(BLOCKS), lambda _: False, np.random.default_rng(1)) is None
    assert draw_instruction(InstructionCounts.of(blocks()), lambda _: True, np.random.default_rng(1)) is None


def test_of_what_is_eligible_alone_the_same_is_drawn() -> None:
    counts = InstructionCounts.of(BLOCKS).only({18, 40}.__contains__)
    assert dict(zip(counts.addresses.tolist(), counts.passes.tolist(), strict=True)) == {18: 12, 40: 3}
    assert counts.leaders == {16, 40, 18}


def test_the_shortest_way_has_the_fewest_passes_in_all() -> None:
    target = DynamicInstruction(address=16, hit=900, passes=1000)
    itself, late, rare, never = ((16,), 900, 899), ((40,), 50, 890), ((60,), 2, 600), ((70,), 0, 0)
    assert shortest_way(blocks(itself, late, rare, never), target) == Way(40, 50, 10)
    assert shortest_way(blocks(rare), target) == Way(60, 2, 300)
    assert shortest_way(blocks(((40,), 880, 870)), target) is None
    assert shortest_way(blocks(), target) is None


def test_the_way_from_a_place_counts_passes_from_there() -> None:
    target = DynamicInstruction(address=16, hit=900, passes=1000)
    before = blocks(((16,), 880, 0), ((40,), 45, 0), ((50,), 9, 3))
    after = blocks(((16,), 900, 899), ((40,), 50, 890), ((50,), 9, 899), ((60,), 1, 896))
    assert shortest_way(after, target, before) == Way(60, 1, 4)
    # Counting the target's own twenty passes is shorter than 5 and 16 others.
    dearer = blocks(((16,), 900, 899), ((40,), 50, 884), ((50,), 9, 899))
    assert shortest_way(dearer, target, before) is None
