"""Chi-square of drawn instructions against calls that are stepped through.

`python -m tests.bench.sampling [SEED [KERNEL..]]`.

Each kernel stands at the beginning of its call on its recorded sample. One copy takes the call in single
steps, another one counts it; instructions are drawn by the counts, for each way to narrow a fault. Where in
the stepped call the drawn ones lie is compared with where the eligible ones lie: in 50 parts of equal length.
Calls of a hundred million instructions are made shorter: fewer iterations, fewer points.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chisquare

from injector.block_profile.counted_call import CountedCall
from injector.block_profile.instruction_counts import InstructionCounts, draw_instruction
from injector.faults.code_scope import countable_code
from injector.faults.eligibility import is_eligible
from injector.isa.host import decode
from injector.isa.instruction import DecodeError
from injector.kernel_study.remote_fork import RemoteForks
from injector.kernel_study.study import at_the_beginning
from injector.kernel_study.subject import MARK, Subject
from injector.tracing.process import Process, ProcessIdentity
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.kernels import KERNELS
from services.models.faults.specification import FaultSpec
from services.perception import samples as perception_samples
from services.planning import samples as planning_samples
from services.planning.planners import plan
from services.runtime import rng

DRAWS, PARTS = 2000, 50
PIECE, MOST_STEPS = 1_000_000, 400_000_000
ITERATIONS = {"rrt_star": 60, "prm_star": 20}
"""Of planners that would take a hundred times as long with all of theirs."""

EVERY_POINT = 16
"""Of the cloud that OctoMap inserts, every so manyth."""

SAMPLED = (
    "pid",
    "point_cloud",
    "octomap",
    "collision_check",
    "rrt",
    "rrt_connect",
    "rrt_star",
    "prm_star",
    "trajectory",
)

NARROWED: dict[str, dict[str, str]] = {
    "all": {},
    **{f"class {name}": {"register_class": name} for name in ("gpr", "vector", "flags", "mask")},
    **{f"field {name}": {"field": name} for name in ("sign", "exponent", "mantissa")},
    **{f"operand {name}": {"operand": name} for name in ("source", "destination")},
    "memory": {"model": "memory"},
    "thread": {"scope": "thread"},
}


class _ThinnedOctomap(perception_samples.OctomapTrial):
    def run(self) -> None:
        self.newest.points = self.newest.points[::EVERY_POINT].copy()
        self.newest.misses = self.newest.misses[::EVERY_POINT].copy()
        super().run()


def shorten(kernel: str) -> None:
    """Have the kernel's calls be short enough to be stepped through."""
    if kernel in ITERATIONS:
        shorter = partial(plan, iterations=ITERATIONS[kernel])
        planning_samples.find_path = shorter  # type: ignore[attr-defined]
    if kernel == "octomap":
        perception_samples.OctomapTrial = _ThinnedOctomap  # type: ignore[misc]


@contextmanager
def standing(kernel: str) -> Iterator[tuple[TraceeGroup, RemoteForks, Tracee]]:
    """A process at the beginning of the kernel's call; gone afterwards."""
    importlib.import_module(KERNELS[kernel].samples_module)
    shorten(kernel)
    pid, go = Subject(KERNELS[kernel]).fork()
    with at_the_beginning(kernel, pid, go) as tracees:
        forks = RemoteForks(tracees)
        yield tracees, forks, tracees.threads[pid]
        for one in list(tracees.threads.values()):
            forks.end(one)


class SteppedCall:
    """A call's instructions in the order in which they are executed, and where each address occurs."""

    def __init__(self, addresses: NDArray[np.uint64]) -> None:
        self.addresses = addresses
        self._by_address = np.argsort(addresses, kind="stable")
        self._sorted = addresses[self._by_address]

    def passes(self, address: int) -> NDArray[np.int64]:
        """Where in the call an address occurs, ascending."""
        wanted = np.uint64(address)
        begin, end = (int(np.searchsorted(self._sorted, wanted, side)) for side in ("left", "right"))
        return self._by_address[begin:end]


def stepped(tracees: TraceeGroup, forks: RemoteForks, root: Tracee) -> SteppedCall:
    """The call in single steps; a repeated instruction counts once."""
    copy = forks.copy(root)
    pieces: list[NDArray[np.uint64]] = []
    while len(pieces) * PIECE < MOST_STEPS:
        pieces.append(np.array(tracees.trace(copy, PIECE), np.uint64))
        assert copy.report is not None
        if copy.report.kind == "gate":
            break
    else:
        message = f"the call is longer than {MOST_STEPS:,} instructions"
        raise SystemExit(message)
    forks.end(copy)
    trace = np.concatenate(pieces)[:-1]
    return SteppedCall(trace[np.concatenate([[True], trace[1:] != trace[:-1]])])


def counted(
    forks: RemoteForks, root: Tracee, fault: FaultSpec
) -> tuple[InstructionCounts, Callable[[int], bool]]:
    """The counts of a copy of the call, and which of its instructions the fault can strike."""
    copy = forks.copy(root)
    with Process(ProcessIdentity.of(copy.pid)) as process:
        call = CountedCall(copy, process, countable_code(fault, process))
        counts = InstructionCounts.of(call.run(MARK))
    forks.end(copy)
    known: dict[int, bool] = {}

    def eligible(address: int) -> bool:
        if address not in known:
            try:
                known[address] = is_eligible(fault, decode(call.code_at(address), address))
            except DecodeError:
                known[address] = False
        return known[address]

    return counts, eligible


def compared(
    call: SteppedCall, counts: InstructionCounts, eligible: Callable[[int], bool], seed: int
) -> tuple[int, float]:
    """How many of the call's instructions are eligible, and the chi-square test's p of the draws."""
    among = {int(one) for one in counts.addresses if eligible(int(one))}
    places = np.flatnonzero(np.isin(call.addresses, np.array(sorted(among), np.uint64)))
    if not len(places):
        return 0, 1.0
    draw = rng.generator(seed, "sampling")
    parts = min(PARTS, len(places))
    drawn = np.zeros(parts)
    for _ in range(DRAWS):
        found = draw_instruction(counts, eligible, draw)
        assert found is not None
        passes = call.passes(found.address)
        assert len(passes) == found.passes
        drawn[int(np.searchsorted(places, passes[found.hit - 1])) * parts // len(places)] += 1
    expected = np.bincount(np.arange(len(places)) * parts // len(places)) / len(places) * DRAWS
    return len(places), float(chisquare(drawn, expected).pvalue)


def study(kernel: str, seed: int) -> dict[str, tuple[int, float]]:
    """Of each way to narrow a fault: eligible instructions and p."""
    found = {}
    with standing(kernel) as (tracees, forks, root):
        call = stepped(tracees, forks, root)
        found["stepped"] = (len(call.addresses), 1.0)
        for name, fields in NARROWED.items():
            fault = FaultSpec.model_validate({"target": kernel, **fields})
            found[name] = compared(call, *counted(forks, root, fault), seed)
    return found


def main() -> None:
    """Print a line a kernel and way."""
    seed, *kernels = sys.argv[1:] or ["1"]
    for kernel in kernels or SAMPLED:
        for name, (eligible, p) in study(kernel, int(seed)).items():
            print(f"{kernel:16} {name:20} {eligible:10,} {p:8.3f}", flush=True)


if __name__ == "__main__":
    main()
