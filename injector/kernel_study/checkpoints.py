"""Run through a call once and stop at every drawn place, where a copy is made for one injection.

To bring each copy to its place from the beginning of the call would cost far more than its fault.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack

import numpy as np

from injector.kernel_study.instruction_index import (
    LIMIT_S,
    REGISTERS,
    InstructionIndex,
    InstructionIndexError,
)
from injector.kernel_study.remote_fork import RemoteForks
from injector.tracing import ptrace
from injector.tracing.perf_events import Breakpoint, await_trap
from injector.tracing.ptrace import StopReport
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.models.base import Strict

BEGINNING = -1
"""Stands for an anchor: the beginning of the call, which is passed once."""


class SamplePoint(Strict):
    """The ``index``-th drawn instruction: ``step`` steps after the ``hit``-th pass through an anchor."""

    index: int
    anchor: int
    hit: int
    step: int


def draw(clock: InstructionIndex, index: int, rng: np.random.Generator) -> SamplePoint:
    """Draw a place by the instruction index; see :mod:`injector.kernel_study.instruction_index`."""
    reaches = np.array([clock.reach, *(one.reach for one in clock.anchors)])
    pairs = np.cumsum(reaches * [1, *(one.passes for one in clock.anchors)])
    drawn = int(rng.integers(int(pairs[-1])))
    which = int(np.searchsorted(pairs, drawn, side="right"))
    hit, step = divmod(drawn - int(pairs[which - 1] if which else 0), int(reaches[which]))
    return SamplePoint(index=index, anchor=which - 1, hit=hit + 1, step=step)


def legs(places: Sequence[SamplePoint], most: int) -> list[list[SamplePoint]]:
    """Divide the places into lots for one run through the call each: of few anchors, at most ``most`` places.

    The largest first, so that who makes them have done at about the same time.
    """
    by_anchor: dict[int, list[SamplePoint]] = defaultdict(list)
    for place in sorted(places, key=lambda one: (one.anchor, one.hit, one.step, one.index)):
        by_anchor[place.anchor].append(place)
    # Those with as many places go together: no leg waits at one anchor for the sake of another.
    order = sorted(by_anchor, key=lambda anchor: (len(by_anchor[anchor]), anchor))
    if BEGINNING in by_anchor:
        order = [BEGINNING, *(anchor for anchor in order if anchor != BEGINNING)]
    found = []
    for at in range(0, len(order), REGISTERS):
        several = [by_anchor[anchor] for anchor in order[at : at + REGISTERS]]
        parts = -(-sum(map(len, several)) // most)
        for part in range(parts):
            cuts = [(len(one) * part // parts, len(one) * (part + 1) // parts) for one in several]
            leg = [place for one, (low, high) in zip(several, cuts, strict=True) for place in one[low:high]]
            found.append(leg)
    return sorted(filter(None, found), key=len, reverse=True)


class CheckpointRun:
    """One run through the call at whose beginning ``root`` stands, which stops at the places of a leg."""

    def __init__(
        self, tracees: TraceeGroup, forks: RemoteForks, root: Tracee, clock: InstructionIndex
    ) -> None:
        self._tracees, self._forks, self._root, self._clock = tracees, forks, root, clock
        self._anchors = frozenset(one.address for one in clock.anchors)

    def visit(self, leg: Sequence[SamplePoint]) -> Generator[tuple[SamplePoint, Tracee | None]]:
        """Each place, and the thread that stands there, to be copied; None if the place is refused.

        :raises InstructionIndexError: if the call takes another path than in the anchor search.
        """
        waiting: dict[int, deque[SamplePoint]] = defaultdict(deque)
        for place in sorted(leg, key=lambda one: (one.hit, one.step, one.index)):
            waiting[place.anchor].append(place)
        thread = self._forks.copy(self._root)
        try:
            yield from self._walk(thread, waiting.pop(BEGINNING, deque()))
            yield from self._pass(thread, waiting)
        finally:
            self._forks.end(thread)

    def _pass(
        self, thread: Tracee, waiting: dict[int, deque[SamplePoint]]
    ) -> Iterator[tuple[SamplePoint, Tracee | None]]:
        by_address = {self._clock.anchors[anchor].address: places for anchor, places in waiting.items()}
        with ExitStack() as held:
            # Opening one takes longer than aiming it anew.
            watched = {at: held.enter_context(Breakpoint(thread, at, held_back=True)) for at in by_address}
            while watched:
                address = self._next(thread, watched, {at: by_address[at][0].hit for at in watched})
                places, hit = by_address[address], by_address[address][0].hit
                here = deque[SamplePoint]()
                while places and places[0].hit == hit:
                    here.append(places.popleft())
                yield from self._walk(thread, here)
                if not places:
                    del watched[address]

    def _next(self, thread: Tracee, watched: dict[int, Breakpoint], wanted: dict[int, int]) -> int:
        """Run until the first of the passes that are waited for; the address.

        Nothing is watched between: a pass that is due at the end of a step would be taken for the step's.

        :raises InstructionIndexError: if there is none.
        """
        for at, breakpoint_ in watched.items():
            breakpoint_.aim(wanted[at] - breakpoint_.hits)
        self._tracees.resume(thread)
        end = await_trap(self._tracees, thread, lambda: False, LIMIT_S)
        for breakpoint_ in watched.values():
            breakpoint_.hold_back()
        address = ptrace.program_counter(thread.tid) if end == "trapped" else 0
        if address not in watched or watched[address].hits != wanted[address]:
            message = f"the call took another path than before: it {end} at {address:#x}"
            raise InstructionIndexError(message)
        return address

    def _walk(
        self, thread: Tracee, places: deque[SamplePoint]
    ) -> Iterator[tuple[SamplePoint, Tracee | None]]:
        """From a pass to the steps after it, until another one is due."""
        taken, over = 0, False
        for place in places:
            while not over and place.step > taken:
                steps, report = ptrace.walk(thread.tid, place.step - taken, self._anchors)
                taken += steps
                thread.report = report or StopReport("step")
                if report is not None and report.kind == "gone":  # somebody killed it: no copy can be made
                    del self._tracees.threads[thread.tid]
                    break
                if report is not None and report.kind == "signal" and ptrace.sent_by_another(thread.tid):
                    # It is no part of the call, and it came before the last of the steps. A copy that was
                    # made between the call for its thread's number and that for the mark sends it to us.
                    taken -= 1
                else:
                    over = report is not None or ptrace.program_counter(thread.tid) in self._anchors
            yield place, None if over else thread
