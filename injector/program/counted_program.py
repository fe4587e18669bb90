"""A whole run of a program in translation, so that the passes through every instruction are counted."""

from __future__ import annotations

import signal
from contextlib import suppress

import numpy as np

from injector.block_profile.counted_call import BlockCounts, UncountableError
from injector.block_profile.translation_memory import TranslationMemoryError
from injector.block_profile.x86_64_translator import TranslationError
from injector.isa.x86_64_registers import X8664Registers
from injector.program.launched_program import LaunchedProgram
from injector.program.translations import ProgramTranslations
from injector.tracing import ptrace
from injector.tracing.process import MemoryMap
from injector.tracing.ptrace import GoneError, StopReport
from injector.tracing.tracee import Tracee

_MOST_STEPS = 64
"""Steps to the end of what a translation does for us."""


class CountedProgram:
    """A launched program that runs to its end in translation; its children run as they are.

    ``maps`` is its memory map at its end.
    """

    def __init__(self, program: LaunchedProgram, stop: tuple[int, int] | None = None) -> None:
        """Make ready: the program stands before its first instruction.

        It can be run to a ``stop``: an address, and the number of a pass through it.

        :raises UncountableError: if there is no room for translations.
        """
        self._program, self._stop = program, stop
        self.translations = ProgramTranslations(program.process, stop)
        self.maps = MemoryMap("")
        self._ending: set[int] = set()

    def run(self, limit_s: float) -> BlockCounts:
        """Run the program to its end; how often each block was passed.

        :raises UncountableError: if it does not run in translation, or not to its end in the time.
        """
        counts = BlockCounts((), np.empty(0, np.uint64), np.empty(0, np.int64), np.empty(0, np.int64))
        try:
            self._begin()
            while self._program.main is not None:
                told = self._program.next_report(limit_s)
                if told is None:
                    message = f"the program did not come to its end in translation within {limit_s:g} s"
                    raise UncountableError(message)
                with suppress(GoneError):
                    counts = self._answer(*told) or counts
        except (TranslationError, TranslationMemoryError) as error:
            raise UncountableError(str(error)) from error
        return counts

    def run_to_stop(self, limit_s: float) -> Tracee:
        """Run to the stop: the thread that stands there, in the program's own code again.

        :raises UncountableError: if the program does not come there.
        """
        try:
            self._begin()
            while (told := self._program.next_report(limit_s)) and self._program.main is not None:
                thread, report = told
                if report.kind == "signal" and self._stands_at_stop(thread):
                    return self._in_own_code(thread)
                with suppress(GoneError):
                    self._answer(thread, report)
        except (TranslationError, TranslationMemoryError) as error:
            raise UncountableError(str(error)) from error
        raise UncountableError("the program did not come to the drawn pass in translation")

    def _begin(self) -> None:
        """Have the program begin in translation."""
        main = self._program.main
        assert main is not None  # noqa: S101 - it stands
        self.translations.give_memory(main.tid)
        ptrace.go_to(main.tid, self.translations.translated(ptrace.program_counter(main.tid)))
        self._program.resume(main)

    def _stands_at_stop(self, thread: Tracee) -> bool:
        return ptrace.program_counter(thread.tid) == self.translations.stop_at

    def _in_own_code(self, thread: Tracee) -> Tracee:
        if len([one for one in self._program.threads.values() if one.pid == thread.pid]) > 1:
            raise UncountableError("the program has several threads, and no place to count the drawn pass")
        assert self._stop is not None  # noqa: S101 - it stands there
        registers = X8664Registers(thread.tid)
        registers.put("rip", self._stop[0])
        registers.put("gs_base", 0)
        registers.commit()
        thread.signals.remove(signal.SIGTRAP)
        thread.report = StopReport("step")
        return thread

    def _answer(self, thread: Tracee, report: StopReport) -> BlockCounts | None:
        """Let a thread go on from what it reports; the counts, if it is about to end the program."""
        if report.kind == "gone":
            return None
        if report.kind == "program" and thread.pid == self._program.pid:
            raise UncountableError("the program executes another one in its place: name that one")
        if report.kind == "exits":
            self._ending.add(thread.tid)
            own = {one.tid for one in self._program.threads.values() if one.pid == self._program.pid}
            if not own <= self._ending:
                counts = None
            else:
                counts, self.maps = self.translations.counts(), self._program.process.maps()
            self._program.resume(thread)
            return counts
        if thread.pid != self._program.pid:
            self._let_child_go(thread)
            return None
        if report.kind == "interrupted":
            self.translations.give_memory(thread.tid)
        if report.kind == "signal":
            return self._on_signal(thread, report)
        self._program.resume(thread)
        return None

    def _let_child_go(self, child: Tracee) -> None:
        """Have a process that the program has forked run its own code."""
        true = self.translations.behind_calls.get(ptrace.program_counter(child.tid))
        if true is not None:
            registers = X8664Registers(child.tid)
            registers.put("gs_base", 0)
            registers.put("rip", true)
            registers.commit()
        self._program.resume(child)

    # -- signals -----------------------------------------------------------------------------------

    def _on_signal(self, thread: Tracee, report: StopReport) -> BlockCounts | None:
        """Lead on who is trapped; deliver another signal, whose handler runs in translation, too."""
        if report.signal == signal.SIGTRAP and self.translations.lead_on(thread.tid):
            thread.signals.remove(signal.SIGTRAP)
            self._program.resume(thread)
            return None
        thread.signals.clear()
        came = self._to_clean_point(thread)
        ptrace.step(thread.tid, report.signal)
        stepped = self._program.await_one(thread)
        for number in came:  # the handler's frame is there: they wait until it lets them in
            ptrace.send(thread.pid, thread.tid, number)
        if stepped.kind != "step":
            return self._answer(thread, stepped)
        at = ptrace.program_counter(thread.tid)
        if not self.translations.is_translation(at):
            ptrace.go_to(thread.tid, self.translations.translated(at))
        self._program.resume(thread)
        return None

    def _to_clean_point(self, thread: Tracee) -> list[int]:
        """Step to where none of our own instructions is under way, which the handler's would disturb.

        Signals that come meanwhile are returned: each takes the place of a step.
        """
        came: list[int] = []
        for _ in range(_MOST_STEPS):
            if self.translations.is_clean(ptrace.program_counter(thread.tid)):
                break
            ptrace.step(thread.tid)
            report = self._program.await_one(thread)
            if report.kind == "signal":
                thread.signals.clear()
                if report.signal != signal.SIGTRAP or not self.translations.lead_on(thread.tid):
                    came.append(report.signal)
        return came
