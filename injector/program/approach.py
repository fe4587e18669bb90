"""Bringing a run of a program to the drawn pass through an instruction."""

from __future__ import annotations

import signal
from contextlib import ExitStack, suppress

from injector.block_profile.counted_call import UncountableError
from injector.block_profile.translation_memory import (
    TranslationMemory,
    TranslationMemoryError,
    map_near,
)
from injector.block_profile.x86_64_translator import TranslationError
from injector.kernel_study.results import SamplePoint
from injector.program.countdown import Countdown
from injector.program.counted_program import CountedProgram
from injector.program.launched_program import LaunchedProgram
from injector.program.watch import RunWatch
from injector.tracing import ptrace
from injector.tracing.perf_events import Breakpoint
from injector.tracing.process import AddressError, Process, ProcessIdentity, VanishedError
from injector.tracing.ptrace import GoneError, StopReport
from injector.tracing.tracee import Tracee

MOST_BY_BREAKPOINT = 80_000
"""Passes that the processor counts, at 5 us each, where no code can be put: in translation a run takes
half a second or more before it has half the program's speed."""

IN_TRANSLATION_S = 600.0
"""Longest wall time without a sign of life of a run in translation."""

_MOST_STEPS = 64
"""Instructions of a block, at most, from where passes are counted to the drawn one."""


class NotReachedError(Exception):
    """The program did not come to the drawn pass: one line."""


class ProgramApproach:
    """Brings a program, which stands before its first instruction, to a drawn pass."""

    def __init__(self, program: LaunchedProgram, point: SamplePoint, watch: RunWatch) -> None:
        self._program, self._point, self._watch = program, point, watch
        self._countdown: Countdown | None = None
        self._breakpoints = ExitStack()
        self._broken: set[int] = set()
        self._borrowers: set[int] = set()

    def run(self) -> Tracee:
        """Run to the pass: the thread that stands before the instruction.

        :raises NotReachedError: if it does not come there.
        """
        main = self._program.main
        assert main is not None  # noqa: S101 - it stands
        point = self._point
        stands_there = ptrace.program_counter(main.tid) == (point.counted_at or point.address)
        try:
            if not point.counted_at and point.hit > MOST_BY_BREAKPOINT:
                return CountedProgram(self._program, point.at).run_to_stop(IN_TRANSLATION_S)
            if point.counted_at:
                # Now: later the program may have a filter of its own for calls of the kernel.
                memory = map_near(main.tid, self._program.process, point.counted_at)
                first = main if stands_there else self._to_breakpoint(point.counted_at, 1)
                thread = self._count_down(first, memory)
            elif stands_there and point.hit == 1:
                return main
            else:
                # Processors do not agree on whether a breakpoint counts where one stands.
                if stands_there:
                    self._program.step(main)
                thread = self._to_breakpoint(point.address, point.hit - stands_there)
            return self._step_on(thread)
        except (TranslationError, TranslationMemoryError, UncountableError, AddressError, GoneError) as error:
            raise NotReachedError(str(error)) from error
        finally:
            self._breakpoints.close()

    def _to_breakpoint(self, address: int, hit: int) -> Tracee:
        """Run until a thread comes to an address, the ``hit``-th time."""

        def watch_over(thread: Tracee) -> None:
            if thread.tid not in self._broken and thread.pid == self._program.pid:
                self._broken.add(thread.tid)
                self._breakpoints.enter_context(Breakpoint(thread, address, hit))

        main = self._program.main
        assert main is not None  # noqa: S101 - it stands
        watch_over(main)
        self._program.resume(main)
        while True:
            thread, report = self._next()
            if report.kind == "timer" and ptrace.program_counter(thread.tid) == address:
                self._breakpoints.close()
                return thread
            if report.kind == "interrupted":
                watch_over(thread)
            self._program.resume(thread)

    def _count_down(self, thread: Tracee, memory: TranslationMemory) -> Tracee:
        """From the first pass through where they are counted to the drawn one."""
        point = self._point
        countdown = Countdown(self._program.process, memory, point.counted_at, point.hit, point.by_way_of)
        self._countdown = countdown
        self._program.resume(thread)
        while True:
            thread, report = self._next()
            if report.kind == "signal" and report.signal == signal.SIGTRAP:
                if ptrace.program_counter(thread.tid) == countdown.trapped_at:
                    thread.signals.remove(signal.SIGTRAP)
                    thread.report = StopReport("step")
                    countdown.close()
                    ptrace.go_to(thread.tid, countdown.address)
                    return thread
            elif thread.pid != self._program.pid:
                self._restore_in_child(thread, report)
            self._program.resume(thread)

    def _restore_in_child(self, child: Tracee, report: StopReport) -> None:
        """A process that the program has forked gets the true code; one that shares its memory lends it."""
        assert self._countdown is not None  # noqa: S101 - counting
        if report.kind == "program" and child.pid in self._borrowers:
            self._borrowers.discard(child.pid)
            self._countdown.put()
        elif report.kind == "interrupted":
            with suppress(VanishedError, AddressError), Process(ProcessIdentity.of(child.pid)) as process:
                self._countdown.close(process)
            if not self._countdown.is_there():
                self._borrowers.add(child.pid)

    def _step_on(self, thread: Tracee) -> Tracee:
        for _ in range(_MOST_STEPS):
            if ptrace.program_counter(thread.tid) == self._point.address:
                return thread
            if self._program.step(thread) != "stepped":
                break
        if ptrace.program_counter(thread.tid) == self._point.address:
            return thread
        raise NotReachedError("the program left the way to the drawn instruction")

    def _next(self) -> tuple[Tracee, StopReport]:
        """What a thread reports that is not gone.

        :raises NotReachedError: if the program ends.
        """
        while True:
            told = self._watch.next_report()
            if told is None:
                raise NotReachedError("the program hung before the drawn pass")
            thread, report = told
            if report.kind == "gone" and thread.pid in self._borrowers and self._countdown is not None:
                self._borrowers.discard(thread.pid)
                self._countdown.put()
            if self._program.main is None:
                raise NotReachedError("the program ended before the drawn pass")
            if report.kind == "program" and thread.pid == self._program.pid:
                raise NotReachedError("the program executed another one before the drawn pass")
            if report.kind != "gone":
                return thread, report
