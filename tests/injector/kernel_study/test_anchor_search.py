"""A survey finds every part of a call, also one that has nothing in common with the rest."""

from collections import Counter
from pathlib import Path

import pytest

from injector.kernel_study.anchor_search import SHORT, AnchorSearch
from injector.kernel_study.function_counts import MOST, count_functions
from injector.kernel_study.instruction_index import InstructionIndex
from injector.kernel_study.subject import MARK
from injector.tracing.elf import CodeLocations
from injector.tracing.process import MemoryMap
from tests.injector.forked_calls import Standing, standing
from tests.injector.small_process import in_small_process

pytestmark = pytest.mark.usefixtures("may_inject")

THREE_PARTS = """
#include <math.h>
#include <stdlib.h>
#define FUNCTION __attribute__((noinline)) static double
FUNCTION first(double x) { return x * 0.5 + 1.0; }
FUNCTION second_inner(double x) { return x / 3.0 - 1.0; }
FUNCTION second(double x) { return second_inner(x) + second_inner(x + 1.0); }
FUNCTION alone(double x) {
    volatile double sum = x;
    for (int i = 0; i < 6000; i++) sum = sum * 0.25 + i;
    return sum;
}
double kernel(void) {
    double sum = 0.0;
    for (int i = 0; i < 4000; i++) sum += first(sum);
    for (int i = 0; i < 6000; i++) sum = second(sum);
    return sum + alone(sum);
}
"""
QUICKER = THREE_PARTS.replace("4000", "1000").replace("6000", "1500")
PARTS = ("kernel", "first", "second", "second_inner", "alone")


def functions_of(one: Standing, addresses: Counter[int]) -> Counter[str]:
    places = CodeLocations(one.root.pid, MemoryMap(Path(f"/proc/{one.root.pid}/maps").read_text()))
    found = Counter[str]()
    for address, count in addresses.items():
        found[places.at(address).symbol] += count
    return found


def within_reach(trace: list[int], clock: InstructionIndex) -> Counter[int]:
    """How often each address is executed within reach of an anchor."""
    reaches = {anchor.address: anchor.reach for anchor in clock.anchors}
    found = Counter[int]()
    reach = passed = 0
    for address in trace:
        if address in reaches:
            reach, passed = reaches[address], 0
        found[address] += passed < reach
        passed += 1
    return found


@pytest.mark.soak
def test_each_part_of_a_call_is_drawn_as_often_as_it_is_long(tmp_path: Path) -> None:
    in_small_process(each_part_is_drawn_as_often_as_it_is_long, tmp_path)


def each_part_is_drawn_as_often_as_it_is_long(tmp_path: Path) -> None:
    with standing(tmp_path, THREE_PARTS) as one:
        trace = one.trace()
        clock = AnchorSearch(one.tracees, one.forks, one.root, MARK).run("three parts")
        every = functions_of(one, Counter(trace))
        drawn = functions_of(one, within_reach(trace, clock))
    assert len(trace) > SHORT
    for anchor in clock.anchors:
        assert trace.count(anchor.address) == anchor.passes
    covered = drawn.total() / len(trace)
    assert covered > 0.9
    assert clock.covered == pytest.approx(covered, abs=0.1)
    for name in PARTS:
        part = every[name] / len(trace)
        assert part > 0.02
        assert drawn[name] / drawn.total() == pytest.approx(part, rel=0.15)


@pytest.mark.soak
def test_a_survey_is_the_same_every_time(tmp_path: Path) -> None:
    in_small_process(two_surveys_are_the_same, tmp_path)


def two_surveys_are_the_same(tmp_path: Path) -> None:
    with standing(tmp_path, QUICKER) as one:
        anchor_search = AnchorSearch(one.tracees, one.forks, one.root, MARK)
        assert anchor_search.run("twice") == anchor_search.run("twice")


@pytest.mark.soak
def test_a_census_counts_the_entries_of_functions(tmp_path: Path) -> None:
    in_small_process(census_counts_the_entries, tmp_path)


def census_counts_the_entries(tmp_path: Path) -> None:
    with standing(tmp_path, THREE_PARTS) as one:
        entries = count_functions(one.forks, one.root, MARK)
        trace = Counter(one.trace())
        names = functions_of(one, Counter(entries))
    assert {name: names[name] for name in PARTS} == dict.fromkeys(PARTS[:1], 1) | {
        "first": MOST,
        "second": MOST,
        "second_inner": MOST,
        "alone": 1,
    }
    for address, count in entries.items():
        assert count == min(trace[address], MOST)
