"""What the survey of a kernel's call says, beside all of the call's instructions, stepped through.

``python -m tests.bench.survey KERNEL ...`` (rrt, rrt_connect); octomap has 23 million of them: minutes.
"""

import os
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from injector.kernel_study.anchor_search import AnchorSearch
from injector.kernel_study.instruction_index import InstructionIndex
from injector.kernel_study.study import subject_injector
from injector.kernel_study.subject import Subject
from injector.tracing.elf import CodeLocations
from injector.tracing.process import MemoryMap
from services.kernels import KERNELS

AT_A_TIME = 200_000
PARTS = 50


def main(names: list[str]) -> None:
    for name in names:
        subject = Subject(KERNELS[name])
        with subject_injector(name, subject, *subject.fork()) as injector:
            tell(name, injector.anchor_search.run(f"clock {name}"), injector.anchor_search)


def tell(name: str, clock: InstructionIndex, anchor_search: AnchorSearch) -> None:
    pid = anchor_search.root.pid
    places = CodeLocations(pid, MemoryMap(Path(f"/proc/{pid}/maps").read_text()))
    every: Counter[int] = Counter()
    within: Counter[int] = Counter()
    lots = []
    reach, passed = clock.reach, 0
    reaches = {one.address: one.reach for one in clock.anchors}
    for lot in instructions(anchor_search):
        reached = 0
        for address in lot:
            if address in reaches:
                reach, passed = reaches[address], 0
            if passed < reach:
                within[address] += 1
                reached += 1
            passed += 1
        every.update(lot)
        lots.append((len(lot), reached / len(lot)))
    length, drawn = every.total(), within.total()
    pairs = clock.reach + sum(one.passes * one.reach for one in clock.anchors)
    print(f"{name}: {length:,} instructions, {len(clock.anchors)} anchors")
    print(f"  within reach {drawn / length:.1%}, by the survey {clock.covered:.1%}")
    print(f"  kept {drawn / pairs:.1%}, by the survey {clock.kept:.1%}")
    print(f"  least within reach of {AT_A_TIME:,} in a row: {min(part for _, part in lots):.1%}")
    by_module = [Counter[str](), Counter[str]()]
    for found, counts in zip(by_module, (every, within), strict=True):
        for address, count in counts.items():
            found[places.at(address).module or "compiled here"] += count
    for module, count in by_module[0].most_common(8):
        print(
            f"  {count / length:6.1%} of all, {by_module[1][module] / drawn:6.1%} of those within: {module}"
        )


def instructions(anchor_search: AnchorSearch) -> Iterator[list[int]]:
    """All of the call, some at a time."""
    copy = anchor_search.forks.copy(anchor_search.root)
    ended = False
    while not ended:
        yield anchor_search.tracees.trace(copy, AT_A_TIME)
        ended = copy.report is not None and copy.report.kind == "gate"
    anchor_search.forks.end(copy)


if __name__ == "__main__":
    main(sys.argv[1:] or ["rrt", "rrt_connect"])
    sys.stdout.flush()
    os._exit(0)
