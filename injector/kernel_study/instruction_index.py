"""How the instructions of a call are counted, so that one of them can be drawn and found again in every run.

The call is divided by the passes through a few addresses, the anchors: an instruction is the ``step``-th
after one pass. To draw one, a pass (the call's beginning counts as one) and a step below its anchor's
``reach`` are drawn, each pair alike, and the place is refused if another pass comes before it. All
instructions within reach of a pass are thus drawn alike. A short call has no anchors and reaches to its end.

Anchors are chosen from traces that begin where functions are entered. Functions are drawn of all that the
call enters (:mod:`injector.kernel_study.function_counts`): a part of the call that has none in common with
the rest is not to be missed. One that is entered often is drawn a little more often than one that is not, but
for how much of the call an instruction of a trace stands is known, as it is known how likely it was to come
into one (Horvitz and Thompson 1952). Nothing here depends on time: the same copies give the same anchors.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from services.models.base import Strict

REACH = 128
"""Steps from a pass to the furthest instruction that is drawn, of any anchor."""

REACHED = 0.98
"""Part of what an anchor could reach that it does: the last few would cost many refusals."""

TRACES = 256
"""Traces, beside that of the call's beginning."""

CHECK_EVERY = 4
"""Every so many traces one is held out once, to tell how good anchors are that were chosen without it."""

COVERED = 0.98
"""Part of the call within reach of an anchor that is enough, by what the traces stand for."""

MOST_ANCHORS = 256
ANCHOR_PASSES = 100.0
"""What an anchor costs beside its passes, in passes: a part of some more runs through the call."""

REGISTERS = 4
"""Addresses that the processor can watch at a time."""

LIMIT_S = 60.0


class InstructionIndexError(Exception):
    """Two copies of a call took different paths: one line."""


class Anchor(Strict):
    """An address that the call passes so many times, and how many steps after it are drawn."""

    address: int
    passes: int
    reach: int = REACH


class InstructionIndex(Strict):
    """The anchors of a call; ``reach`` is that of its beginning.

    ``covered`` is the part of its instructions within reach of a pass, estimated from traces that were not
    looked at in choosing them, and so too low; ``kept`` that of the drawn places which are not refused.
    """

    reach: int
    anchors: tuple[Anchor, ...] = ()
    covered: float = 1.0
    kept: float = 1.0


@dataclass(frozen=True)
class TraceSample:
    """Traces of a call, the first from its beginning, and for how many instructions each one of them stands.

    ``weights`` are as long as ``traces``.
    """

    traces: Sequence[Sequence[int]]
    weights: Sequence[NDArray[np.float64]]

    @classmethod
    def of(cls, traces: Sequence[Sequence[int]], rates: Mapping[int, float]) -> TraceSample:
        """Of traces at functions' entries, so many of which (``rates``) begin a trace; the first is sure to.

        An instruction may have come into a trace by each of the entries before it. Those before its own
        trace are not known, so that a trace's first instructions stand for a little too much.
        """
        weights = []
        for number, trace in enumerate(traces):
            entered = np.array([rates.get(address, 0.0) for address in trace])
            weights.append(1.0 / (np.cumsum(entered) + (number == 0)))
        return cls(traces, weights)

    def anchors(self, reach: int = REACH) -> list[int]:
        """Addresses within whose ``reach`` nearly all of the call lies, with few passes through them.

        Greedily, the one that covers most for each pass.
        """
        spans = self._spans(reach)
        weight = np.concatenate(list(self.weights))
        costs = {one: float(weight[begin].sum()) + ANCHOR_PASSES for one, (begin, _) in spans.items()}
        uncovered = weight.copy()

        def worth(address: int) -> float:
            begin, end = spans[address]
            return float((left[end] - left[begin]).sum() / costs[address])

        left = np.concatenate(([0.0], np.cumsum(uncovered)))
        enough = (1 - COVERED) * left[-1]
        heap = [(-worth(address), address) for address in spans]
        heapq.heapify(heap)
        chosen: list[int] = []
        while heap and left[-1] > enough and len(chosen) < MOST_ANCHORS:
            _, address = heapq.heappop(heap)
            value = worth(address)
            if heap and value < -heap[0][0]:  # others cover a part of it by now
                heapq.heappush(heap, (-value, address))
                continue
            for begin, end in zip(*spans[address], strict=True):
                uncovered[begin:end] = 0.0
            chosen.append(address)
            left = np.concatenate(([0.0], np.cumsum(uncovered)))
        return chosen

    def _spans(self, reach: int) -> dict[int, tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Where, in all traces in a row, the reaches begin and end of each address that can be an anchor."""
        lengths = [len(trace) for trace in self.traces]
        ends = np.repeat(np.cumsum(lengths), lengths)
        at: dict[int, list[int]] = defaultdict(list)
        for number, address in enumerate(address for trace in self.traces for address in trace):
            at[address].append(number)
        repeating = {one for trace in self.traces for one, other in pairwise(trace) if one == other}
        # Whether a pass counts that it stands at when it is first let go, processors do not agree on.
        unusable = repeating | {self.traces[0][0]}
        found = {}
        for address in sorted(at.keys() - unusable):
            begin = np.array(at[address])
            found[address] = (
                begin,
                np.minimum(np.minimum(begin + reach, ends[begin]), [*begin[1:], len(ends)]),
            )
        return found

    def clock(self, passes: Mapping[int, int]) -> InstructionIndex:
        """The instruction index of anchors that the call passes so many times."""
        gaps = self.gaps(passes)
        reaches = {address: reach_of(*gaps[address]) for address in passes}
        within = sum(
            count * float(np.average(np.minimum(gaps[one][0], reaches[one]), weights=gaps[one][1]))
            for one, count in passes.items()
        )
        anchors = [Anchor(address=one, passes=count, reach=reaches[one]) for one, count in passes.items()]
        pairs = sum(one.passes * one.reach for one in anchors)
        return InstructionIndex(
            reach=REACH, anchors=tuple(anchors), covered=self.covered(), kept=within / max(1, pairs)
        )

    def covered(self) -> float:
        """The part within reach of anchors that are chosen from some of the traces, by the other traces."""
        checks = TraceSample(self.traces[::CHECK_EVERY], self.weights[::CHECK_EVERY])
        chosen = [at for at in range(len(self.traces)) if at % CHECK_EVERY]
        others = TraceSample([self.traces[at] for at in chosen], [self.weights[at] for at in chosen])
        gaps = others.gaps(others.anchors())
        reaches = {address: reach_of(*both) for address, both in gaps.items()}
        within = 0.0
        for trace, weight in zip(checks.traces, checks.weights, strict=True):
            passed = [at for at, address in enumerate(trace) if address in reaches]
            for one, other in pairwise([*passed, len(trace)]):
                within += float(weight[one : min(other, one + reaches[trace[one]])].sum())
        return within / float(np.concatenate(list(checks.weights)).sum())

    def gaps(self, anchors: Collection[int]) -> dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Steps from the passes through each anchor to the next pass through any, or to a trace's end.

        With the weights of the passes.
        """
        found: dict[int, list[tuple[int, float]]] = {address: [] for address in anchors}
        for trace, weight in zip(self.traces, self.weights, strict=True):
            passes = [at for at, address in enumerate(trace) if address in found]
            for one, other in pairwise([*passes, len(trace)]):
                found[trace[one]].append((other - one, weight[one]))
        return {
            address: (np.array([gap for gap, _ in both]), np.array([weight for _, weight in both]))
            for address, both in found.items()
        }


def reach_of(gaps: NDArray[np.int64], weights: NDArray[np.float64], reach: int = REACH) -> int:
    """How many steps after an anchor are to be drawn: ``REACHED`` of those up to ``reach`` are within."""
    within = np.minimum.outer(np.arange(1, reach + 1), gaps) @ weights
    return 1 + int(np.searchsorted(within, REACHED * within[-1]))


def begun_at(entries: Mapping[int, int], draw: np.random.Generator) -> tuple[list[int], dict[int, float]]:
    """The functions at which the traces of a call begin that enters so many times each function.

    A function as often in the mean as the logarithm of its entries says. And how many traces begin at an
    entry of each, in the mean.
    """
    sizes = np.log2(1.0 + np.array(list(entries.values())))
    expected = TRACES * sizes / sizes.sum()
    points = np.arange(TRACES) + draw.random()
    drawn = np.searchsorted(np.cumsum(expected), points).clip(max=len(entries) - 1)
    functions = list(entries)
    rates = {one: float(some) / entries[one] for one, some in zip(functions, expected, strict=True)}
    return [functions[int(one)] for one in drawn], rates
