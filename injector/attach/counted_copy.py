"""How often a call of any process executes each instruction: counted in a copy of it, which changes nothing.

The copy runs the call in translation (:mod:`injector.block_profile`). It may ask the kernel only for what
nobody outside of it notices, and writes no memory that others share; a call that does more is not counted.
"""

from __future__ import annotations

import signal
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from injector.attach.function_calls import CallFrame
from injector.attach.process_copy import copy_at_entry
from injector.attach.untrapped_tracees import UntrappedTracees
from injector.block_profile.counted_call import BlockCounts, CountedCall, UncountableError
from injector.block_profile.injected_call import CopyError
from injector.block_profile.instruction_counts import (
    FEW_PASSES,
    DynamicInstruction,
    InstructionCounts,
    Way,
    draw_instruction,
    way_from_the_beginning,
)
from injector.faults.eligibility import is_eligible
from injector.isa.host import decode
from injector.isa.instruction import DecodeError
from injector.tracing import ptrace
from injector.tracing.elf import code_sections
from injector.tracing.process import AddressError, Process
from injector.tracing.ptrace import GoneError, StopReport, SystemCall
from injector.tracing.tracee import Tracee
from injector.tracing.waiting import wait_until
from services.models.faults.specification import FaultSpec

LEAST_S, MOST_S, SLOWER = 2.0, 30.0, 50
"""Wall time after which a copy is killed, for it waits for somebody who is not copied: so many times that of
the call, within these bounds."""

_NOWHERE = 0x1000
"""An address below those that Linux maps, to which the copy's call returns."""

_WORD_SIZE = 8
_HARMLESS = frozenset(
    {
        *(4, 5, 6, 262, 332, 21, 269),  # stat and its like, access
        *(10, 11, 12, 25, 28),  # mprotect, munmap, brk, mremap, madvise
        *(13, 14, 15, 131, 127),  # signal handlers and masks
        *(17, 295),  # pread64, preadv
        *(24, 39, 63, 96, 98, 99, 100, 102, 104, 107, 108, 110, 186, 201, 204, 228, 229, 309, 318),
        *(158, 324, 334),  # arch_prctl, membarrier, rseq
    }
)
"""Numbers of calls of the kernel that change nothing outside of the process: the long row asks for numbers,
times and random bytes."""
_NAMES = {0: "read", 1: "write", 16: "ioctl", 20: "writev", 44: "sendto", 46: "sendmsg", 202: "futex"}
_NAMES |= {35: "nanosleep", 230: "clock_nanosleep", 257: "openat", 56: "clone", 7: "poll"}
_NAMES |= {234: "tgkill, by which it aborts: an exception of C++ passes through it"}
_MMAP, _FUTEX, _SHARED = 9, 202, 1
_PROTECTING = frozenset({10, 25, 28})
_WAITS = frozenset({0, 6, 9, 11, 13})  # FUTEX_WAIT, LOCK_PI, WAIT_BITSET, WAIT_REQUEUE_PI, LOCK_PI2
_FUTEX_COMMAND = 127


@dataclass(frozen=True, slots=True)
class CountedPlace:
    """A dynamic instruction that was drawn from a call that executes ``executed``, and a ``way`` there."""

    instruction: DynamicInstruction
    executed: int
    way: Way | None = None

    @property
    def passes(self) -> int:
        """How many passes are counted on the way."""
        return self.instruction.hit if self.way is None else self.way.hit + self.way.rest


class EndlessCopyError(UncountableError):
    """A copy does not come to the end of its call: it waits for others, as another one would."""


class CallCounter:
    """Counts the call at whose beginning a thread stands, in copies of its process, and draws from it."""

    def __init__(
        self,
        tracees: UntrappedTracees,
        thread: Tracee,
        process: Process,
        frame: CallFrame,
        fault: FaultSpec,
        took_ns: int,
    ) -> None:
        """Make ready to count a call that takes about ``took_ns``."""
        self._tracees, self._thread, self._process = tracees, thread, process
        self._frame, self._fault = frame, fault
        self._limit_s = min(max(LEAST_S, SLOWER * took_ns / 1e9), MOST_S)

    def draw(self, draw: np.random.Generator) -> CountedPlace | None:
        """Draw one of the call's dynamic instructions that the fault can strike, all alike; None: none is.

        The thread stands meanwhile; it is led through a few instructions of its own (:func:`copy_at_entry`).

        :raises UncountableError: if the call is not counted.
        :raises GoneError: if the thread is killed.
        """
        call, blocks = self._count()
        counts = InstructionCounts.of(blocks)
        drawn = draw_instruction(counts, lambda address: self._is_eligible(call, address), draw)
        if drawn is None or drawn.hit <= FEW_PASSES:
            return None if drawn is None else CountedPlace(drawn, counts.executed)
        _, blocks = self._count(counts.leaders, {drawn.address: [drawn.hit]})
        return CountedPlace(drawn, counts.executed, way_from_the_beginning(blocks, drawn))

    def _is_eligible(self, call: CountedCall, address: int) -> bool:
        try:
            return is_eligible(self._fault, decode(call.code_at(address), address))
        except DecodeError:
            return False

    def _count(
        self,
        leaders: Collection[int] = frozenset(),
        stops: Mapping[int, Sequence[int]] | None = None,
    ) -> tuple[CountedCall, BlockCounts]:
        """The call in a copy of its own, up to the stop if one is given, and what was passed until then."""
        try:
            with copy_at_entry(self._tracees, self._thread, self._process) as (copy, process):
                try:
                    return self._run(copy, process, leaders, stops)
                except (GoneError, AddressError) as error:
                    message = f"a copy of it did not come to its end within {self._limit_s:g} s"
                    raise EndlessCopyError(message) from error
        except CopyError as error:
            raise UncountableError(str(error)) from error

    def _run(
        self,
        copy: Tracee,
        process: Process,
        leaders: Collection[int],
        stops: Mapping[int, Sequence[int]] | None,
    ) -> tuple[CountedCall, BlockCounts]:
        process.write_memory(self._frame.stack, _NOWHERE.to_bytes(_WORD_SIZE, "little"))
        call = _HarmlessCall(self._tracees, copy, process, leaders, stops)
        call.limit_s = self._limit_s
        stopped = call.to_next_stop(signal.SIGSEGV)
        if stopped is None and ptrace.program_counter(copy.tid) != _NOWHERE:
            raise UncountableError(
                "it writes memory that it shares with others, or uses some that no copy has"
            )
        if stopped is None and stops:
            raise UncountableError("the call ended before the pass that another copy made")
        return call, call.counts()


class _HarmlessCall(CountedCall):
    """A call in a copy that is stopped before it does anything that others would notice."""

    def __init__(
        self,
        tracees: UntrappedTracees,
        copy: Tracee,
        process: Process,
        leaders: Collection[int],
        stops: Mapping[int, Sequence[int]] | None,
    ) -> None:
        pieces = [
            one
            for one in process.maps().code()
            if "w" not in one.permissions and "r" in one.permissions and not one.name.startswith("[")
        ]
        code = sorted(section for one in pieces for section in code_sections(process.pid, one))
        super().__init__(copy, process, code, leaders=leaders, stops=stops)
        self._tracees = tracees
        self._shared = [(one.start, one.end) for one in process.maps().shared()]

    def _next_report(self, number: int) -> StopReport:
        """Let the copy run, and its original's other threads, too; calls of the kernel are looked at."""
        tid = self._thread.tid
        while True:
            ptrace.resume_to_call(tid, number)
            report = self._await(tid)
            if report.kind != "call":
                return report
            number = 0
            asked = ptrace.system_call(tid)
            if asked is not None and not self._is_harmless(asked):
                what = _NAMES.get(asked.number, f"system call {asked.number}")
                message = f"it asks the kernel for what others may notice: {what}"
                raise UncountableError(message)

    def _await(self, tid: int) -> StopReport:
        def look() -> StopReport | None:
            self._tracees.service()
            return ptrace.poll(tid)

        return wait_until(look, 2 * self.limit_s) or StopReport("gone")

    def _is_harmless(self, asked: SystemCall) -> bool:
        number, arguments, native = asked
        if not native:
            return False
        if number == _MMAP:
            return not arguments[3] & _SHARED
        if number == _FUTEX:
            return arguments[1] & _FUTEX_COMMAND not in _WAITS and not self._is_shared(arguments[0], 1)
        if number in _PROTECTING:
            return not self._is_shared(*arguments[:2])
        return number in _HARMLESS

    def _is_shared(self, begin: int, size: int) -> bool:
        return any(begin < end and start < begin + size for start, end in self._shared)
