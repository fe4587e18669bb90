"""How the instructions of a call are counted, so that one of them can be drawn and found again in every run.

The call is divided by the passes through a few addresses, the anchors: an instruction is the ``step``-th
after one pass. To draw one, a pass (the call's beginning counts as one) and a step below its anchor's
``reach`` are drawn, each pair alike, and the place is refused if another pass comes before it. All
instructions within reach of a pass are thus drawn alike. A short call has no anchors and reaches to its end.

Where to look for anchors is drawn as well: an instruction of the trace at hand, one of the passes through
its address, and a trace from there. This leaves the uniform distribution over a call's instructions as it
is (it draws a new one among those of the same address, then goes on a little), so the traces come to
stand for the call. Nothing here depends on time: the same copies give the same anchors.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from injector.copies import Copies
from injector.freeze import Tracees
from injector.thread import Thread
from injector.trigger import Breakpoint, await_trap
from services.bus.model import Strict

SHORT = 30_000
"""Instructions of a call up to which all are stepped through: a good half second."""

REACH = 128
"""Steps from a pass to the furthest instruction that is drawn, of any anchor."""

REACHED = 0.98
"""Part of what an anchor could reach that it does: the last few would cost many refusals."""

CHAINS = 4
"""Chains of traces, each of which goes on from its last; several workers can make them."""

TRACES = 24
"""Traces of each chain."""

TRACE = 1_000
"""Instructions of each trace."""

CHECK_EVERY = 4
"""Every so many traces one is held out once, to tell how good anchors are that were chosen without it."""

MOST_PASSES = 3_000
"""Passes beyond which an address counts as passed as often as that while anchors are looked for."""

COVERED = 0.98
"""Part of the traces within reach of an anchor that is enough."""

MOST_ANCHORS = 256
REGISTERS = 4
"""Addresses that the processor can watch at a time."""

LIMIT_S = 60.0


class ClockError(Exception):
    """Two copies of a call went different ways: one line."""


class Anchor(Strict):
    """An address that the call passes so many times, and how many steps after it are drawn."""

    address: int
    passes: int
    reach: int = REACH


class Clock(Strict):
    """The anchors of a call; ``reach`` is that of its beginning.

    ``covered`` is the part of its instructions within reach of a pass, estimated from traces that were not
    looked at in choosing them, and so a little too low.
    ``kept``: about which part of the drawn places is not refused.
    """

    reach: int
    anchors: tuple[Anchor, ...] = ()
    covered: float = 1.0
    kept: float = 1.0


class Surveyor:
    """Looks for the anchors of the call at whose beginning ``root`` stands."""

    def __init__(self, tracees: Tracees, copies: Copies, root: Thread) -> None:
        self._tracees, self._copies, self._root = tracees, copies, root

    def begin(self) -> tuple[list[int], bool]:
        """The call's first instructions, and whether it has no more."""
        return self._trace(0, 0, SHORT)

    def chain(self, begin: list[int], draw: np.random.Generator) -> list[list[int]]:
        """Traces of drawn parts of the call, each by way of the one before, the first of ``begin``."""
        traces = [begin]
        while len(traces) <= TRACES:
            traces.append(self._another(traces[-1], draw))
        return traces[1:]

    def _another(self, trace: Sequence[int], draw: np.random.Generator) -> list[int]:
        usable = watchable(trace)
        address = usable[int(draw.integers(len(usable)))]
        passes = self._passes(address)
        return self._trace(address, 1 + int(draw.integers(passes)), TRACE)[0]

    def _trace(self, address: int, hit: int, most: int) -> tuple[list[int], bool]:
        """Up to ``most`` instructions from a pass (0: the beginning) on; whether the call ended meanwhile."""
        copy = self._copies.copy(self._root)
        try:
            if hit and not self._reaches(copy, address, hit):
                message = f"a copy of the call passed {address:#x} fewer times than {hit}"
                raise ClockError(message)
            found = self._tracees.trace(copy, most)
            return found, copy.report is not None and copy.report.kind == "gate"
        finally:
            self._copies.end(copy)

    def _passes(self, address: int) -> int:
        """How often the call passes an address, up to ``MOST_PASSES``."""
        copy = self._copies.copy(self._root)
        try:
            with Breakpoint(copy, address, MOST_PASSES) as passes:
                self._tracees.resume(copy)
                await_trap(self._tracees, copy, lambda: False, LIMIT_S)
                return passes.hits
        finally:
            self._copies.end(copy)

    def _reaches(self, copy: Thread, address: int, hit: int) -> bool:
        with Breakpoint(copy, address, hit):
            self._tracees.resume(copy)
            return await_trap(self._tracees, copy, lambda: False, LIMIT_S) == "trapped"

    def count(self, addresses: Sequence[int]) -> dict[int, int]:
        """How often the call passes each address."""
        found: dict[int, int] = {}
        for at in range(0, len(addresses), REGISTERS):
            some = addresses[at : at + REGISTERS]
            copy = self._copies.copy(self._root)
            counts = [Breakpoint(copy, address) for address in some]
            try:
                self._tracees.resume(copy)
                if await_trap(self._tracees, copy, lambda: False, LIMIT_S) != "finished":
                    raise ClockError("a copy that was left alone did not end its call")
                found |= {address: count.hits for address, count in zip(some, counts, strict=True)}
            finally:
                for count in counts:
                    count.close()
                self._copies.end(copy)
        return found


def watchable(trace: Sequence[int]) -> list[int]:
    """The addresses of a trace; not of what follows on itself, whose repetitions may count as one pass."""
    repeating = {one for one, other in pairwise(trace) if one == other}
    return [address for address in trace if address not in repeating]


def usable_anchors(traces: Sequence[Sequence[int]]) -> list[int]:
    """The anchors of a call of which these are traces, the first from its beginning."""
    # Whether a pass counts that it stands at when it is first let go, processors do not agree on.
    return [address for address in choose(traces) if address != traces[0][0]]


def clock_of(traces: Sequence[Sequence[int]], passes: Mapping[int, int]) -> Clock:
    """The clock by anchors that the call passes so many times."""
    checks = traces[::CHECK_EVERY]
    others = [one for number, one in enumerate(traces) if number % CHECK_EVERY]
    reaches = reaches_of(traces, list(passes))
    return Clock(
        reach=REACH,
        anchors=tuple(Anchor(address=one, passes=count, reach=reaches[one]) for one, count in passes.items()),
        covered=coverage(checks, reaches_of(others, choose(others))),
        kept=kept(traces, reaches),
    )


def choose(traces: Sequence[Sequence[int]], reach: int = REACH) -> list[int]:
    """Addresses within whose ``reach`` nearly all of the traces lies, with few passes through them.

    Greedily, the one that covers most for each pass.
    """
    length = sum(map(len, traces))
    ends = np.repeat(np.cumsum([len(trace) for trace in traces]), [len(trace) for trace in traces])
    at: dict[int, list[int]] = defaultdict(list)
    for number, address in enumerate(address for trace in traces for address in trace):
        at[address].append(number)
    repeating = {one for trace in traces for one, other in pairwise(trace) if one == other}
    spans: dict[int, tuple[NDArray[np.int64], NDArray[np.int64]]] = {}
    for address in sorted(at.keys() - repeating):
        begin = np.array(at[address])
        spans[address] = begin, np.minimum(np.minimum(begin + reach, ends[begin]), [*begin[1:], length])
    uncovered = np.ones(length, dtype=np.int64)

    def worth(address: int, left: NDArray[np.int64]) -> float:
        begin, end = spans[address]
        return float((left[end] - left[begin]).sum() / (len(begin) + 1))

    left = np.arange(length + 1)
    heap = [(-worth(address, left), address) for address in spans]
    heapq.heapify(heap)
    chosen: list[int] = []
    while heap and left[-1] > (1 - COVERED) * length and len(chosen) < MOST_ANCHORS:
        _, address = heapq.heappop(heap)
        value = worth(address, left)
        if heap and value < -heap[0][0]:  # others cover a part of it by now
            heapq.heappush(heap, (-value, address))
            continue
        for begin, end in zip(*spans[address], strict=True):
            uncovered[begin:end] = 0
        chosen.append(address)
        left = np.concatenate(([0], np.cumsum(uncovered)))
    return chosen


def gaps(traces: Sequence[Sequence[int]], anchors: Collection[int]) -> dict[int, list[int]]:
    """Steps from the passes through each anchor to the next pass through any, or to a trace's end."""
    found: dict[int, list[int]] = {address: [] for address in anchors}
    for trace in traces:
        passes = [at for at, address in enumerate(trace) if address in found]
        for one, other in pairwise([*passes, len(trace)]):
            found[trace[one]].append(other - one)
    return found


def reaches_of(
    traces: Sequence[Sequence[int]], addresses: Sequence[int], reach: int = REACH
) -> dict[int, int]:
    """How many steps after each anchor are to be drawn: ``REACHED`` of those up to ``reach`` are within."""
    found = {}
    for address, steps in gaps(traces, addresses).items():
        within = np.minimum.outer(np.arange(1, reach + 1), np.array(steps, dtype=np.int64)).sum(axis=1)
        found[address] = 1 + int(np.searchsorted(within, REACHED * within[-1]))
    return found


def coverage(traces: Sequence[Sequence[int]], reaches: Mapping[int, int]) -> float:
    """The part of the traces that lies within reach of these anchors."""
    within = sum(min(gap, reaches[one]) for one, steps in gaps(traces, reaches).items() for gap in steps)
    return within / sum(map(len, traces))


def kept(traces: Sequence[Sequence[int]], reaches: Mapping[int, int]) -> float:
    """The part of the pairs of pass and step before which no other pass comes."""
    both = [(gap, reaches[one]) for one, steps in gaps(traces, reaches).items() for gap in steps]
    return sum(min(gap, reach) for gap, reach in both) / max(1, sum(reach for _, reach in both))
