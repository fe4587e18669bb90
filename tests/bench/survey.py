"""What the survey of a kernel's call says, beside all of the call's instructions, stepped through.

``python -m tests.bench.survey KERNEL ...`` (rrt, rrt_connect); octomap has 23 million of them: minutes.
"""

import os
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from injector.clock import Clock
from injector.elf import Places
from injector.process import Maps
from injector.study import striking
from injector.subject import Subject
from injector.survey import Surveyor
from services.kernels import KERNELS

AT_A_TIME = 200_000
PARTS = 50


def main(names: list[str]) -> None:
    for name in names:
        subject = Subject(KERNELS[name])
        with striking(name, subject, *subject.fork()) as strikes:
            tell(name, strikes.surveyor.survey(f"clock {name}"), strikes.surveyor)


def tell(name: str, clock: Clock, surveyor: Surveyor) -> None:
    pid = surveyor.root.pid
    places = Places(pid, Maps(Path(f"/proc/{pid}/maps").read_text()))
    every: Counter[int] = Counter()
    within: Counter[int] = Counter()
    lots = []
    reach, passed = clock.reach, 0
    reaches = {one.address: one.reach for one in clock.anchors}
    for lot in instructions(surveyor):
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


def instructions(surveyor: Surveyor) -> Iterator[list[int]]:
    """All of the call, some at a time."""
    copy = surveyor.copies.copy(surveyor.root)
    ended = False
    while not ended:
        yield surveyor.tracees.trace(copy, AT_A_TIME)
        ended = copy.report is not None and copy.report.kind == "gate"
    surveyor.copies.end(copy)


if __name__ == "__main__":
    main(sys.argv[1:] or ["rrt", "rrt_connect"])
    sys.stdout.flush()
    os._exit(0)
