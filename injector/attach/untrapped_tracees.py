"""Tracing a process that does not cooperate without raising traps, so that it survives if we are killed.

A process without a handler for traps dies of a single step that is under way when its tracer is killed: the
kernel lets go of the thread but leaves the trap flag set. The same goes for a breakpoint's SIGTRAP, which is
then delivered. So no trap is ever raised here. Perf events are
delivered as SIGURG (or SIGWINCH), which is ignored by default but shown to a tracer all the same; and a step
is a breakpoint at each place that the instruction can lead to.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

from injector.faults.stopped_thread import TargetError, registers_of
from injector.isa.instruction import DecodeError
from injector.isa.x86_64_successors import UnpredictableError, successors
from injector.tracing import ptrace
from injector.tracing.perf_events import StepBreakpoint
from injector.tracing.process import AddressError, CodeError, Process
from injector.tracing.ptrace import GoneError, StopReport
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import FAULTS, STEP_LIMIT_S, TraceeGroup
from injector.tracing.waiting import wait_until

NOTICES = (signal.SIGURG, signal.SIGWINCH)
"""Signals that do nothing by default, but are shown to a tracer."""

_POLL_IN, _POLL_HUP = 1, 6


class UntrappedTracees(TraceeGroup):
    """The threads of one process. Perf events on them are to be given ``notice``."""

    def __init__(self, process: Process, notice: int) -> None:
        super().__init__()
        self.process = process
        self.notice = notice
        self.ends: dict[int, StopReport] = {}
        self._stepping: Tracee | None = None
        self._breakpoints: list[StepBreakpoint] = []

    def __exit__(self, *details: object) -> None:
        self._leave_steps()
        super().__exit__(*details)

    def _take_in(self, thread: Tracee, report: StopReport) -> StopReport:
        if report.kind == "gone":
            self.ends[thread.tid] = report
        if report.kind == "signal" and report.signal == self.notice:
            with suppress(GoneError):
                if ptrace.signal_code(thread.tid) in (_POLL_IN, _POLL_HUP):
                    report = StopReport("timer")
        return super()._take_in(thread, report)

    def resume(self, thread: Tracee) -> None:
        """Let one standing thread run; the breakpoints of its step are taken away first."""
        if thread is self._stepping:
            self._leave_steps()
        super().resume(thread)

    def await_one(
        self,
        threads: Sequence[Tracee],
        right: Callable[[Tracee], bool],
        deadline: float,
        insist: Callable[[], None] = lambda: None,
    ) -> Tracee | None:
        """Let all run until one of some threads stands at an event where it is right; None at the deadline.

        ``insist`` is called about every millisecond meanwhile.

        :raises TargetError: if all of these threads have ended.
        """

        def look() -> Tracee | None:
            self.service()
            if not any(one.tid in self.threads for one in threads):
                raise TargetError("the thread ended")
            for one in list(self.threads.values()):
                if one.report is not None and one.report.kind == "timer":
                    if one in threads and right(one):
                        return one
                    self.resume(one)
            insist()
            return None

        return wait_until(look, deadline - time.monotonic())

    def news_of(self, thread: Tracee) -> StopReport | None:
        """What a running thread reports, if anything; the others are seen to, and go on."""
        thread.report = StopReport("step")
        self.service()
        thread.report = None
        return self._look(thread)

    def resume_others(self, thread: Tracee) -> None:
        """Let all but one standing thread run: it may wait for them."""
        for one in list(self.threads.values()):
            if one is not thread and one.report is not None:
                self.resume(one)
        self._pause.end()

    def step(self, thread: Tracee) -> Literal["stepped", "ended", "faulted", "gone", "stuck"]:
        """Let a standing thread execute one instruction, or wait for its system call to return.

        As :meth:`TraceeGroup.step`, but the others may run: what they have to tell is taken in.

        :raises TargetError: if nobody knows where the instruction leads.
        """
        try:
            after = self._after(thread)
        except GoneError:
            return "gone"
        if after == ():  # it jumps to itself
            return "stepped"
        self._aim(thread, after or ())
        deadline = time.monotonic() + STEP_LIMIT_S
        while True:
            thread.report = None
            with suppress(GoneError):  # killed; its end is reported next
                ptrace.resume(thread.tid)
            report = self._await_step(thread, deadline)
            if report is None:
                self._leave_steps()
                return "stuck"
            if report.kind == "gone":
                return "gone"
            if report.kind == "timer" and self._address(thread) in (after or ()):
                return "stepped"
            if report.kind == "signal" and report.signal in FAULTS:
                return "faulted"

    def _address(self, thread: Tracee) -> int:
        try:
            return registers_of(thread).program_counter
        except GoneError:
            return -1

    def _after(self, thread: Tracee) -> tuple[int, ...] | None:
        """Where a standing thread goes from here; None: nowhere, it raises a signal."""
        registers = registers_of(thread)
        address = registers.program_counter

        def word(at: int) -> int:
            return int.from_bytes(self.process.read_memory(at, 8), "little")

        try:
            return successors(self.process.read_code(address), address, registers, word)
        except UnpredictableError as error:
            raise TargetError(str(error)) from error
        except (DecodeError, CodeError, AddressError):
            return None

    def _aim(self, thread: Tracee, places: tuple[int, ...]) -> None:
        if self._stepping is not thread:
            self._leave_steps()
            self._stepping = thread
        while len(self._breakpoints) < len(places):
            self._breakpoints.append(StepBreakpoint(thread, self.notice))
        for number, breakpoint_ in enumerate(self._breakpoints):
            breakpoint_.move(places[number] if number < len(places) else None)

    def _leave_steps(self) -> None:
        for one in self._breakpoints:
            one.close()
        self._breakpoints.clear()
        self._stepping = None

    def _await_step(self, thread: Tracee, deadline: float) -> StopReport | None:
        if self._pause.under_way:  # the others stand
            return self._await(thread, deadline)
        return wait_until(lambda: self._look_at_all(thread), deadline - time.monotonic())

    def _look_at_all(self, thread: Tracee) -> StopReport | None:
        found = self._look(thread)
        if found is None:
            for other in self._running():
                if other is not thread:
                    news = self._look(other)
                    if news is not None and news.kind not in ("gone", "timer"):
                        self.resume(other)
        return found


def notice_for(tids: Iterable[int]) -> int | None:
    """The signal by which threads can be stopped: the one that fewest block, if not all.

    Of two alike the one that the process does not catch.
    """
    masks = [_masks(tid) for tid in tids]
    best = min(
        NOTICES,
        key=lambda number: (
            sum(blocked >> number - 1 & 1 for blocked, _ in masks),
            any(caught >> number - 1 & 1 for _, caught in masks),
        ),
    )
    return None if all(blocked >> best - 1 & 1 for blocked, _ in masks) else best


def _masks(tid: int) -> tuple[int, int]:
    """The signals that a thread blocks and those that its process catches; all, if it is gone."""
    try:
        text = Path(f"/proc/{tid}/status").read_text()
    except OSError:
        return -1, 0
    blocked, caught = (
        int(text.partition(f"{name}:")[2].split(maxsplit=1)[0], 16) for name in ("SigBlk", "SigCgt")
    )
    return blocked, caught
