"""Run through a call once and stop at every drawn instruction, where a copy is made for one injection.

To bring each copy to its place from the beginning of the call would cost far more than its fault. The copy
that goes through the call is untouched: its breakpoints are the processor's. From where it stands, the
way to the next place is what passes the fewest of them; a copy in translation has found it before.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import groupby
from typing import NamedTuple

from injector.block_profile.counted_call import CountedCall
from injector.block_profile.instruction_counts import (
    DynamicInstruction,
    Way,
    shortest_way,
    way_from_the_beginning,
)
from injector.faults.call_profile import counted_call
from injector.isa.host import decode
from injector.kernel_study.remote_fork import RemoteForks
from injector.kernel_study.results import Pass, SamplePoint
from injector.tracing import ptrace
from injector.tracing.perf_events import Breakpoint, await_trap
from injector.tracing.process import Process, ProcessIdentity, VanishedError
from injector.tracing.ptrace import GoneError
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.models.faults.specification import FaultSpec

LIMIT_S = 60.0
"""Wall time after which a call that does not come to a place is given up."""


class CheckpointError(Exception):
    """A copy of the call took another path than the one that was counted: one line."""


class Stop(NamedTuple):
    """A point, the thread that stands there, and a quicker way there from the call's beginning, if any."""

    point: SamplePoint
    thread: Tracee
    way: Way | None


class CheckpointRun:
    """Runs through the call at whose beginning ``root`` stands, with stops at drawn instructions.

    These lie in the code of ``fault``'s scope, whose blocks begin at ``leaders``. Signal ``mark`` ends the
    call.
    """

    def __init__(
        self,
        tracees: TraceeGroup,
        forks: RemoteForks,
        root: Tracee,
        mark: int,
        fault: FaultSpec,
        leaders: frozenset[int],
    ) -> None:
        self._tracees, self._forks, self._root = tracees, forks, root
        self._mark, self._fault, self._leaders = mark, fault, leaders

    def in_order(self, points: Sequence[SamplePoint]) -> list[SamplePoint]:
        """The points in the order in which the call comes to them.

        :raises CheckpointError: if it does not come to all of them.
        :raises UncountableError: if it does not run in translation.
        :raises GoneError: if somebody kills the copy.
        """
        by_pass: dict[Pass, list[SamplePoint]] = defaultdict(list)
        for point in points:
            by_pass[point.at].append(point)
        found: list[SamplePoint] = []
        with self._translated(by_pass) as call:
            while by_pass:
                found.extend(by_pass.pop(self._next(call)))
        return found

    def visit(self, leg: Sequence[SamplePoint]) -> Generator[Stop]:
        """Stop at each point of a leg, which is in the call's order; the thread there is to be copied.

        Who was killed on the way there is told of with the point; no copy can be made of it.

        :raises CheckpointError, UncountableError, GoneError: as :meth:`in_order` does.
        """
        places = [(at, list(here)) for at, here in groupby(leg, key=lambda point: point.at)]
        ways = self._ways([at for at, _ in places])
        thread = self._forks.copy(self._root)
        # Counted is from here on; the instruction at which it stands was a pass, too.
        stood_at = ptrace.program_counter(thread.tid)
        try:
            for ((address, _), here), (way, whole_way) in zip(places, ways, strict=True):
                self._to_a_pass(thread, way.address, way.hit - (way.address == stood_at))
                self._to_a_pass(thread, address, way.rest)
                stood_at = 0
                for point in here:
                    yield Stop(point, thread, whole_way)
        finally:
            self._forks.end(thread)

    def _ways(self, places: Sequence[Pass]) -> list[tuple[Way, Way | None]]:
        """The way to each place from the one before it, and a quicker one from the beginning."""
        before = None
        ways = []
        with self._translated(places) as call:
            for address, hit in places:
                call.watch(address)
                if self._next(call) != (address, hit):
                    raise CheckpointError("the call came to its places in another order than before")
                counts = call.counts()
                passed = 0
                if before is not None:
                    passed = int(before.passes[before.leaders == address].sum())
                here = DynamicInstruction(address, hit, hit)
                way = shortest_way(counts, here, before) or Way(address, hit - passed, 0)
                ways.append((way, way_from_the_beginning(counts, here, before)))
                before = counts
        return ways

    def _next(self, call: CountedCall) -> Pass:
        stop = call.to_next_stop(self._mark)
        if stop is None:
            raise CheckpointError("the call ended before a pass that another copy made")
        return stop

    @contextmanager
    def _translated(self, places: Iterable[Pass]) -> Iterator[CountedCall]:
        """A copy in translation that stops at the places; gone afterwards."""
        stops: dict[int, list[int]] = defaultdict(list)
        for address, hit in sorted(places):
            stops[address].append(hit)
        copy = self._forks.copy(self._root)
        try:
            with Process(ProcessIdentity.of(copy.pid)) as process:
                yield counted_call(copy, process, self._fault, leaders=self._leaders, stops=stops)
        finally:
            self._forks.end(copy)

    def _to_a_pass(self, thread: Tracee, address: int, hit: int) -> None:
        """Run to the ``hit``-th pass through an address from here on, this one not counted.

        Processors do not agree on whether a breakpoint counts where one stands, so that is stepped away from.
        """
        with suppress(GoneError, VanishedError):  # killed: that is told of where no copy can be made
            while hit > 0:
                self._step(thread)
                if ptrace.program_counter(thread.tid) != address:
                    self._run_to(thread, address, hit)
                    return
                hit -= 1

    def _run_to(self, thread: Tracee, address: int, hit: int) -> None:
        end = ""
        with Breakpoint(thread, address, hit):
            while not end or self._is_a_strangers_mark(thread, end):
                self._tracees.resume(thread)
                end = await_trap(self._tracees, thread, lambda: False, LIMIT_S)
        if end in ("finished", "late"):
            message = f"the call took another path than before: it {end} before {address:#x}"
            raise CheckpointError(message)

    def _step(self, thread: Tracee) -> None:
        """Execute the instruction at which a thread stands, all of it if it is a repeated one."""
        begin = ptrace.program_counter(thread.tid)
        with Process(ProcessIdentity.of(thread.pid)) as process:
            instruction = decode(process.read_code(begin), begin)
        if instruction.text.startswith("rep") or not instruction.steppable:
            self._run_to(thread, begin + len(instruction.code), 1)
            return
        end = ""
        while not end or self._is_a_strangers_mark(thread, end):
            end = self._tracees.step(thread)
        if end not in ("stepped", "gone"):
            message = f"the call took another path than before: it {end} at {begin:#x}"
            raise CheckpointError(message)

    @staticmethod
    def _is_a_strangers_mark(thread: Tracee, end: str) -> bool:
        """Whether it was a mark that another process sent, which is no part of this call.

        A copy that was made between the call for its thread's number and that for the mark sends it to us.
        """
        return end in ("ended", "finished") and ptrace.sent_by_another(thread.tid)
