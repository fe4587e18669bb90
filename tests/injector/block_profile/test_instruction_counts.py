"""The law of the draw, and the shortest way to what was drawn."""

from collections import Counter

import numpy as np
import pytest
from scipy.stats import chisquare

from injector.block_profile.counted_call import CountedBlock
from injector.block_profile.instruction_counts import (
    DynamicInstruction,
    InstructionCounts,
    Way,
    draw_instruction,
    shortest_way,
)

pytestmark = pytest.mark.unit

BLOCKS = [
    CountedBlock((16, 18, 24), 7, 0),
    CountedBlock((40, 44), 3, 0),
    CountedBlock((18, 24), 5, 0),
    CountedBlock((60,), 0, 0),
]
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
    assert draw_instruction(InstructionCounts.of([]), lambda _: True, np.random.default_rng(1)) is None


def test_the_shortest_way_has_the_fewest_passes_in_all() -> None:
    target = DynamicInstruction(address=16, hit=900, passes=1000)
    late, rare, never = CountedBlock((40,), 50, 890), CountedBlock((60,), 2, 600), CountedBlock((70,), 0, 0)
    assert shortest_way([CountedBlock((16,), 900, 899), late, rare, never], target) == Way(40, 50, 10)
    assert shortest_way([rare], target) == Way(60, 2, 300)
    assert shortest_way([CountedBlock((40,), 880, 870)], target) is None
    assert shortest_way([], target) is None
