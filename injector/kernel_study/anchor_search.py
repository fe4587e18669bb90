"""Search of a call's anchors, by copies of it that run ahead of those into which faults are injected.

Several workers can each do a part of it; it does not depend on which.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from injector.kernel_study.function_counts import MOST, count_functions
from injector.kernel_study.instruction_index import (
    LIMIT_S,
    REGISTERS,
    InstructionIndex,
    InstructionIndexError,
    TraceSample,
    begun_at,
)
from injector.kernel_study.remote_fork import RemoteForks
from injector.tracing.perf_events import Breakpoint, await_trap
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.models.base import Strict
from services.runtime import rng

T = TypeVar("T")

SHORT = 30_000
"""Instructions of a call up to which all are stepped through: a good half second."""

TRACE = 1_000
"""Instructions of each trace."""

MOST_PASSES = 3_000
"""Entries of a function among which the one is drawn at which a trace begins."""

_TRACES_AT_A_TIME = 8


class TraceRequest(Strict):
    """A part of an anchor search: a trace of the call's beginning, if nothing else is asked for.

    Or the entries of the functions that it enters (``count_functions``); or a trace from an entry of each of
    ``functions`` (number, address, entries); or how often it passes each of ``addresses``.
    """

    count_functions: bool = False
    functions: tuple[tuple[int, int, int], ...] = ()
    addresses: tuple[int, ...] = ()


class TraceReply(Strict):
    """What a part of an anchor search found: traces (``whole``: of all of the call), or passes by address."""

    traces: tuple[tuple[int, ...], ...] = ()
    whole: bool = False
    passes: tuple[tuple[int, int], ...] = ()


def search_anchors(
    ask: Callable[[Sequence[TraceRequest]], Iterable[TraceReply]], seed: str
) -> InstructionIndex:
    """The clock of a call, by the answers, in any order, of those who have copies of it.

    ``seed`` names the draws.

    :raises InstructionIndexError: if the call enters no function that a loaded file tells of.
    """
    (begin,) = ask([TraceRequest()])
    (first,) = begin.traces
    if begin.whole:
        return InstructionIndex(reach=len(first))
    (found,) = ask([TraceRequest(count_functions=True)])
    entries = dict(found.passes)
    if not entries:
        raise InstructionIndexError("the call enters no function that a loaded file tells of")
    functions, rates = begun_at(entries, rng.generator(0, seed, 0))
    begun = [(number + 1, one, entries[one]) for number, one in enumerate(functions)]
    traced = ask([TraceRequest(functions=tuple(lot)) for lot in _lots(begun, _TRACES_AT_A_TIME)])
    traces = sorted(trace for one in traced for trace in one.traces)
    sample = TraceSample.of([first[:TRACE], *traces], rates)
    anchors = sample.anchors()
    # Each runs once through the call; some take far longer than others.
    counted = ask([TraceRequest(addresses=tuple(lot)) for lot in _lots(anchors, REGISTERS)])
    passes = dict(pair for one in counted for pair in one.passes)
    return sample.clock({address: passes[address] for address in anchors})


def _lots(items: Sequence[T], most: int) -> list[Sequence[T]]:
    return [items[at : at + most] for at in range(0, len(items), most)]


@dataclass(frozen=True)
class AnchorSearch:
    """Searches the anchors of the call at whose beginning ``root`` stands; it ends with signal ``mark``."""

    tracees: TraceeGroup
    forks: RemoteForks
    root: Tracee
    mark: int

    def run(self, seed: str) -> InstructionIndex:
        """Do all parts of the search one after the other."""
        return search_anchors(lambda parts: [self.answer(part, seed) for part in parts], seed)

    def answer(self, asked: TraceRequest, seed: str) -> TraceReply:
        """Do one part of the search; its answer is the same in every run."""
        if asked.addresses:
            return TraceReply(passes=tuple(self.count(asked.addresses).items()))
        if asked.count_functions:
            return TraceReply(passes=tuple(count_functions(self.forks, self.root, self.mark).items()))
        if asked.functions:
            traces = (
                self.trace(address, entries, rng.generator(0, seed, number))
                for number, address, entries in asked.functions
            )
            return TraceReply(traces=tuple(map(tuple, traces)))
        begin, whole = self.begin()
        return TraceReply(traces=(tuple(begin),), whole=whole)

    def begin(self) -> tuple[list[int], bool]:
        """The call's first instructions, and whether it has no more."""
        return self._trace(0, 0, SHORT)

    def trace(self, function: int, entries: int, draw: np.random.Generator) -> list[int]:
        """A trace from a drawn entry of a function, which the count found to be entered so often."""
        entries = entries if entries < MOST else self._entries(function)
        return self._trace(function, 1 + int(draw.integers(entries)), TRACE)[0]

    def _trace(self, address: int, hit: int, most: int) -> tuple[list[int], bool]:
        """Up to ``most`` instructions from a pass (0: the beginning) on; whether the call ended meanwhile."""
        copy = self.forks.copy(self.root)
        try:
            if hit and not self._reaches(copy, address, hit):
                message = f"a copy of the call passed {address:#x} fewer times than {hit}"
                raise InstructionIndexError(message)
            found = self.tracees.trace(copy, most)
            return found, copy.report is not None and copy.report.kind == "gate"
        finally:
            self.forks.end(copy)

    def _entries(self, function: int) -> int:
        """How often the call enters a function, up to ``MOST_PASSES``."""
        copy = self.forks.copy(self.root)
        try:
            with Breakpoint(copy, function, MOST_PASSES) as passes:
                self.tracees.resume(copy)
                await_trap(self.tracees, copy, lambda: False, LIMIT_S)
                return passes.hits
        finally:
            self.forks.end(copy)

    def _reaches(self, copy: Tracee, address: int, hit: int) -> bool:
        with Breakpoint(copy, address, hit):
            self.tracees.resume(copy)
            return await_trap(self.tracees, copy, lambda: False, LIMIT_S) == "trapped"

    def count(self, addresses: Sequence[int]) -> dict[int, int]:
        """How often the call passes each address."""
        found: dict[int, int] = {}
        for at in range(0, len(addresses), REGISTERS):
            some = addresses[at : at + REGISTERS]
            copy = self.forks.copy(self.root)
            counts = [Breakpoint(copy, address) for address in some]
            try:
                self.tracees.resume(copy)
                if await_trap(self.tracees, copy, lambda: False, LIMIT_S) != "finished":
                    raise InstructionIndexError("a copy that was left alone did not end its call")
                found |= {address: count.hits for address, count in zip(some, counts, strict=True)}
            finally:
                for count in counts:
                    count.close()
                self.forks.end(copy)
        return found
