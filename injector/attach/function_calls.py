"""Calls of one function of a process that does not cooperate: where they begin, and when they are over.

A function may begin at several places: as variants that the compiler made of it, or as copies in several
files. Whichever is called first is the one whose calls are meant from then on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import iced_x86
from iced_x86 import FlowControl

from injector.attach.untrapped_tracees import UntrappedTracees
from injector.faults.approach import MissedError
from injector.faults.stopped_thread import registers_of
from injector.tracing.perf_events import Breakpoint, ThreadTimer
from injector.tracing.process import AddressError, Process, sleeps
from injector.tracing.symbols import LoadedFunction
from injector.tracing.tracee import Tracee

BREAKPOINTS = 4
"""How many places in code a processor of x86-64 watches."""

TURN_S = 0.2
"""Wall time for which some places are watched, if there are more than the processor watches at once."""

COPY_S = 2.0
"""Wall time after which a copy that was not called does not run, if that of another file was called."""

LOOK_NS = 10_000_000
"""Thread time between two looks at whether a call is still under way."""

MOST_HITS = 2**62
"""Passes that the kernel counts at most, and more than any call has."""

LOOP_BYTES = 4096
"""Bytes of code of a function that are searched for jumps to its beginning."""

_JUMPS = (FlowControl.CONDITIONAL_BRANCH, FlowControl.UNCONDITIONAL_BRANCH)


@dataclass(frozen=True, slots=True)
class CalledFunction:
    """A function by the places where it may begin, and copies ``elsewhere`` that may run in its stead."""

    variants: Sequence[LoadedFunction]
    elsewhere: Sequence[LoadedFunction] = ()

    @property
    def name(self) -> str:
        """Its whole name, as C++ or Rust has it."""
        return self.variants[0].full_name


@dataclass(frozen=True, slots=True)
class CallFrame:
    """A call that is under way: where it returns to, the stack pointer at its beginning, the stack's end."""

    returns_to: int
    stack: int
    stack_end: int

    def is_left_at(self, stack_pointer: int) -> bool:
        """Whether who has this stack pointer is out of the call; on another stack nobody knows."""
        return self.stack < stack_pointer < self.stack_end


class FunctionCalls:
    """Brings threads to the beginning and to the end of calls of a function, within a time limit."""

    def __init__(
        self, tracees: UntrappedTracees, process: Process, function: CalledFunction, limit_s: float
    ) -> None:
        self._tracees, self._process, self._function = tracees, process, function
        self._limit_s = limit_s
        self._deadline = time.monotonic() + limit_s
        self._entries = tuple(one.address for one in function.variants)
        self._loops: dict[int, bool] = {}

    def arrive(self, threads: Sequence[Tracee], number: int = 1) -> Tracee:
        """Let all run until one of some threads stands at the function's beginning, the ``number``-th time.

        The calls are those of one thread: whose comes first. All are of the variant that it calls first.

        :raises MissedError: if none comes there in time.
        """
        for one in threads:
            if one.report is not None and address_of(one) in self._entries:
                step(self._tracees, one)
        if number > 1 and (len(threads) > 1 or len(self._entries) > 1):
            thread = self._first(threads)
            step(self._tracees, thread)
            return self._next([thread], number - 1)
        return self._next(threads, number) if self._is_known else self._first(threads)

    @property
    def _is_known(self) -> bool:
        return len(self._entries) == 1 and not self._function.elsewhere

    def _next(self, threads: Sequence[Tracee], number: int) -> Tracee:
        (entry,) = self._entries
        with ExitStack() as held:
            for one in threads:
                held.enter_context(Breakpoint(one, entry, number, self._tracees.notice))
            self._tracees.resume_all()
            thread = self._tracees.await_one(threads, self._stands_at_an_entry, self._deadline)
        if thread is None:
            raise self._late("a call" if number == 1 else f"{number} calls")
        return thread

    def _first(self, threads: Sequence[Tracee]) -> Tracee:
        """Let all run until the function is called at one of its places, the only one from then on."""
        watch = _Elsewhere(self._function)
        while True:
            for entries, others in self._turns():
                thread = self._turn(threads, entries, others, watch)
                if thread is not None:
                    self._entries = (address_of(thread),)
                    self._function = CalledFunction(
                        [one for one in self._function.variants if one.address in self._entries]
                    )
                    return thread
                if time.monotonic() >= self._deadline:
                    raise self._late("a call")

    def _turns(self) -> Iterator[tuple[Sequence[int], Sequence[LoadedFunction]]]:
        """What is watched one after the other: places of the function, and copies elsewhere beside them."""
        others = self._function.elsewhere
        most = BREAKPOINTS - 1 if others else BREAKPOINTS
        for at in range(0, len(self._entries), most):
            entries = self._entries[at : at + most]
            free = BREAKPOINTS - len(entries)
            for beside in range(0, len(others) or 1, free):
                yield entries, others[beside : beside + free]

    def _turn(
        self,
        threads: Sequence[Tracee],
        entries: Sequence[int],
        others: Sequence[LoadedFunction],
        watch: _Elsewhere,
    ) -> Tracee | None:
        end = self._deadline
        if len(entries) < len(self._entries) or len(others) < len(self._function.elsewhere):
            end = min(end, time.monotonic() + TURN_S)
        with ExitStack() as held:
            counted = []
            for one in threads:
                for address in entries:
                    held.enter_context(Breakpoint(one, address, 1, self._tracees.notice))
                counted += [(other, held.enter_context(Breakpoint(one, other.address))) for other in others]
            self._tracees.resume_all()
            return self._tracees.await_one(
                threads, self._stands_at_an_entry, end, lambda: watch.look(counted)
            )

    def _stands_at_an_entry(self, thread: Tracee) -> bool:
        return address_of(thread) in self._entries

    def _late(self, calls: str) -> MissedError:
        return MissedError(
            "not_reached", f"the function was not reached within {self._limit_s:g} s ({calls})"
        )

    # -- the end of a call --------------------------------------------------------------------------

    def frame(self, thread: Tracee) -> CallFrame:
        """The call at whose beginning a thread stands."""
        stack = registers_of(thread).stack_pointer
        mapping = self._process.maps().at(stack)
        returns_to = int.from_bytes(self._process.read_memory(stack, 8), "little")
        return CallFrame(returns_to, stack, mapping.end if mapping is not None else 2**64)

    @staticmethod
    def is_over(thread: Tracee, frame: CallFrame) -> bool:
        """Whether a standing thread is out of a call."""
        return frame.is_left_at(registers_of(thread).stack_pointer)

    def is_left(self, frame: CallFrame, stack_pointer: int) -> bool:
        """Whether who has this stack pointer is out of a call, or has called others since from outside."""
        word = self._process.read_memory(frame.stack, 8)
        return frame.is_left_at(stack_pointer) or int.from_bytes(word, "little") != frame.returns_to

    def is_left_asleep(self, thread: Tracee, frame: CallFrame) -> bool:
        """Whether a thread, which is not stopped, waits in the kernel outside of a call of its own."""
        if not sleeps(thread.tid):
            return False
        try:
            told = Path(f"/proc/{thread.pid}/task/{thread.tid}/syscall").read_text().split()
            # One that stands at its return meanwhile is in no call of the kernel: -1.
            return len(told) > 2 and told[0] != "-1" and self.is_left(frame, int(told[-2], 16))
        except (OSError, AddressError):  # it ends
            return False

    def complete(self, thread: Tracee, frame: CallFrame) -> bool:
        """Let all run until a call has returned; False if it was left otherwise (longjmp, an exception).

        :raises MissedError: if it is not over in time.
        """
        with suppress(LeftError):
            return self._complete(thread, frame)
        return False

    def _complete(self, thread: Tracee, frame: CallFrame) -> bool:
        notice, hit = self._tracees.notice, 1
        (entry,) = self._entries  # a thread that has been stepped on stands elsewhere
        with ExitStack() as held:
            held.enter_context(Breakpoint(thread, frame.returns_to, 1, notice))
            # Who calls it again, with as much on the stack as before, has left it. Whom it calls itself has
            # more: ever fewer of these are looked at, for they may be many.
            again = held.enter_context(Breakpoint(thread, entry, hit, notice))
            while True:
                with ThreadTimer(thread, LOOK_NS, notice) as timer:
                    self._tracees.resume_all()
                    stopped = self._tracees.await_one(
                        [thread], lambda _: True, self._deadline, self._look_asleep(thread, frame, timer)
                    )
                if stopped is None:
                    limit = f"within {self._limit_s:g} s"
                    raise MissedError(
                        "not_reached", f"the function did not return {limit}: give --step or --cpu-s"
                    )
                here, stack = address_of(thread), registers_of(thread).stack_pointer
                if here == frame.returns_to and frame.is_left_at(stack):
                    return True
                if self.is_left(frame, stack):
                    return False
                if here == entry and stack == frame.stack and not self._jumps_to(entry):
                    return False
                if here == entry:
                    hit = min(2 * hit, MOST_HITS)
                    again.aim(hit)

    def _jumps_to(self, entry: int) -> bool:
        """Whether code behind a function's beginning jumps there: a loop, which leaves the call under way."""
        if entry not in self._loops:
            mapping = self._process.maps().at(entry)
            size = min(LOOP_BYTES, mapping.end - entry) if mapping is not None else 0
            code = iced_x86.Decoder(64, self._process.read_memory(entry, size), ip=entry)
            self._loops[entry] = any(
                one.flow_control in _JUMPS and one.near_branch_target == entry for one in code
            )
        return self._loops[entry]

    def _look_asleep(self, thread: Tracee, frame: CallFrame, timer: ThreadTimer) -> Callable[[], None]:
        """What is to be done every now and then: stop a thread that sleeps outside of the call."""

        def look() -> None:
            timer.insist()
            if self.is_left_asleep(thread, frame):
                raise LeftError

        return look


class LeftError(Exception):
    """A call was left otherwise than by its return, and its thread sleeps."""


class _Elsewhere:
    """Watches whether copies in other files run while the one that was asked for does not."""

    def __init__(self, function: CalledFunction) -> None:
        self._own = function.variants[0]
        self._since: dict[str, float] = {}

    def look(self, counted: Sequence[tuple[LoadedFunction, Breakpoint]]) -> None:
        """Look at the calls of other copies that were counted.

        :raises MissedError: if another copy runs.
        """
        for other, passes in counted:
            if passes.hits:
                self._since.setdefault(other.file, time.monotonic())
        for file, since in self._since.items():
            if time.monotonic() - since > COPY_S:
                copy = f"the copy of {self._own.full_name} in {self._own.file} is not called"
                reason = f"{copy}, that in {file} is: give --module {file}, or none"
                raise MissedError("not_reached", reason)


def address_of(thread: Tracee) -> int:
    """The address of the instruction at which a thread stands."""
    return registers_of(thread).program_counter


def step(tracees: UntrappedTracees, thread: Tracee) -> None:
    """Let a standing thread execute one instruction.

    :raises MissedError: if it does not come through it.
    """
    end = tracees.step(thread)
    if end != "stepped":
        what = {"gone": "ended", "faulted": "raised a signal", "stuck": "waits in a system call"}
        raise MissedError("failed", f"before the fault: thread {thread.tid} {what.get(end, end)}")
