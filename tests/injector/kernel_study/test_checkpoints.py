"""Places are drawn uniformly over a call's instructions, by exhaustive single steps, and reached again."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chisquare

from injector.kernel_study.checkpoints import BEGINNING, CheckpointRun, SamplePoint, draw, legs
from injector.kernel_study.instruction_index import Anchor, InstructionIndex, TraceSample, reach_of
from injector.tracing import ptrace
from services.runtime.rng import generator
from tests.injector.faults.test_drawn_sites import KERNELS
from tests.injector.forked_calls import Standing, standing

pytestmark = pytest.mark.usefixtures("may_inject")

PLACES = 600
REACH = 12


def clock_of(trace: Sequence[int]) -> InstructionIndex:
    """Anchors as a survey chooses them, but of the whole call."""
    parts = [trace[at : at + 100] for at in range(0, len(trace), 100)]
    sample = TraceSample(parts, [np.ones(len(part)) for part in parts])
    repeating = {one for one, other in pairwise(trace) if one == other}
    gaps = sample.gaps([one for one in sample.anchors(REACH) if one not in repeating])
    anchors = [
        Anchor(address=one, passes=trace.count(one), reach=reach_of(*both, REACH))
        for one, both in gaps.items()
    ]
    return InstructionIndex(reach=REACH, anchors=tuple(anchors))


def numbered(trace: Sequence[int], clock: InstructionIndex) -> dict[tuple[int, int, int], int]:
    """Each instruction's number in the call by its place: anchor, hit and step."""
    by_address = {one.address: number for number, one in enumerate(clock.anchors)}
    hits: Counter[int] = Counter()
    found, anchor, hit, step = {}, BEGINNING, 1, 0
    for number, address in enumerate(trace):
        if address in by_address:
            anchor = by_address[address]
            hits[anchor] += 1
            hit, step = hits[anchor], 0
        if step < (clock.reach if anchor == BEGINNING else clock.anchors[anchor].reach):
            found[anchor, hit if anchor != BEGINNING else 1, step] = number
        step += 1
    return found


def visited(one: Standing, clock: InstructionIndex, places: Sequence[SamplePoint]) -> dict[int, int | None]:
    """Where the program stands at each place; None: it was refused."""
    run = CheckpointRun(one.tracees, one.forks, one.root, clock)
    return {
        place.index: None if thread is None else ptrace.program_counter(thread.tid)
        for leg in legs(places, 100)
        for place, thread in run.visit(leg)
    }


@pytest.mark.parametrize("precision", ["exact", "occurrence"])
@pytest.mark.parametrize("name", KERNELS)
def test_places_are_distributed_as_single_steps_count_them(tmp_path: Path, name: str, precision: str) -> None:
    with standing(tmp_path, KERNELS[name]) as one:
        trace = one.trace()
        assert 100 < len(trace) < 3000
        assert one.trace() == trace
        clock = InstructionIndex(reach=len(trace)) if precision == "exact" else clock_of(trace)
        places = [draw(clock, index, generator(1, f"sweep {name}", index)) for index in range(PLACES)]
        found = visited(one, clock, places)
    assert set(found) == set(range(PLACES))
    number = numbered(trace, clock)
    for place in places:
        expected = number.get((place.anchor, place.hit, place.step))
        assert found[place.index] == (None if expected is None else trace[expected])
    # In tenths of the instructions that can be drawn, in their order: all alike.
    order = {at: rank for rank, at in enumerate(sorted(number.values()))}
    ranks = [
        order[number[place.anchor, place.hit, place.step]]
        for place in places
        if found[place.index] is not None
    ]
    tenths = Counter(rank * 10 // len(order) for rank in ranks)
    sizes = Counter(rank * 10 // len(order) for rank in range(len(order)))
    counts = [tenths[at] for at in range(10)]
    assert len(ranks) > 100
    assert chisquare(counts, [len(ranks) * sizes[at] / len(order) for at in range(10)]).pvalue > 0.01
    # And by address, as often as single steps count them.
    executed = Counter(trace[at] for at in number.values())
    drawn = Counter(trace[sorted(number.values())[rank]] for rank in ranks)
    often = {at: len(ranks) * times / len(order) for at, times in executed.items()}
    often = {at: times for at, times in often.items() if times >= 5}
    assert len(often) > 5
    rest = len(ranks) - sum(often.values())
    seen = [drawn[at] for at in often]
    extra = ([len(ranks) - sum(seen)], [rest]) if rest > 1 else ([], [])
    scale = sum(seen) / sum(often.values()) if not extra[0] else 1.0
    expected_counts = [times * scale for times in often.values()]
    assert chisquare([*seen, *extra[0]], [*expected_counts, *extra[1]]).pvalue > 0.01


def test_a_short_call_is_covered_whole_and_a_long_one_as_far_as_is_told(tmp_path: Path) -> None:
    with standing(tmp_path, KERNELS["memory"]) as one:
        trace = one.trace()
    clock = clock_of(trace)
    covered = len(numbered(trace, clock)) / len(trace)
    assert 0.9 < covered <= 1.0
    assert len(numbered(trace, InstructionIndex(reach=len(trace)))) == len(trace)
