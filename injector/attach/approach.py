"""Approach in a process that does not cooperate: by function, by library, or by processor time.

No probe of it can be sent ahead, so earlier calls of the function are observed instead: the rehearsals.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from injector.attach.untrapped_tracees import UntrappedTracees
from injector.faults.apply import apply_fault
from injector.faults.approach import Approach, MissedError
from injector.faults.corruption import Corruption
from injector.faults.stopped_thread import InjectionResult, registers_of
from injector.tracing.perf_events import Breakpoint, ThreadTimer
from injector.tracing.process import MemoryMapping, Process
from injector.tracing.tracee import Tracee
from injector.tracing.waiting import wait_until
from services.models.faults.specification import FaultSpec

SHORT_NS = 2_000_000
"""Longest thread time of a call that is stepped through."""

MOST_STEPS = 20_000
"""Instructions after which a call counts as too long for that: a second of wall time."""

CPU_S = (0.0, 0.01)
"""Thread time within which a fault is injected, if nothing else is asked for."""

SAMPLE_NS = 1_000_000
"""Most thread time between two looks at whether a thread is in a library."""

_FOR_EVER_NS = 10**15


@dataclass(frozen=True, slots=True)
class AttachTarget:
    """Where in a process to inject. Pairs are ranges, ends included, of which one value is drawn.

    A function's ``entry`` (0: none), or the ``code`` of a library (none: all). ``tids`` are the threads
    that come into question. ``call`` counts calls of the function from 1; ``step`` names the instruction of
    the call, ``cpu_s`` thread time after its beginning, or from now on. ``after_s`` is wall time before all
    that.
    """

    tids: tuple[int, ...]
    entry: int = 0
    code: Sequence[MemoryMapping] = ()
    call: tuple[int, int] = (1, 1)
    step: int | None = None
    cpu_s: tuple[float, float] | None = None
    after_s: tuple[float, float] = (0.0, 0.0)
    limit_s: float = 60.0


@dataclass
class ApproachReport:
    """How the injection point was reached: what was drawn, and what the rehearsals told."""

    precision: Literal["exact", "rehearsed", "cpu_time"] = "cpu_time"
    tid: int = 0
    call: int = 0
    step: int | None = None
    instructions: int | None = None
    cpu_ns: int | None = None
    rehearsals: int = 0


@dataclass
class _Frame:
    """A call that is under way: where it returns to, and the stack pointer at its beginning."""

    returns_to: int
    stack: int


@dataclass
class AttachApproach(Approach):
    """Brings a thread of any process to the injection point. ``report`` tells how far it came."""

    DIED = "the process ended before the fault"

    tracees: UntrappedTracees
    process: Process
    target: AttachTarget
    fault: FaultSpec
    corruption: Corruption
    draw: np.random.Generator
    report: ApproachReport = field(default_factory=ApproachReport)
    _deadline: float = 0.0

    def _run(self) -> InjectionResult:
        self._deadline = time.monotonic() + self.target.limit_s + self.target.after_s[1]
        self.report.tid = self.target.tids[0]
        self._wait(self._between(self.target.after_s))
        if self.target.entry:
            return self._in_a_call()
        thread = self._thread(self.target.tids[0])
        return self._in_a_library(thread) if self.target.code else self._after(thread, None)

    # -- in a call of a function --------------------------------------------------------------------

    def _in_a_call(self) -> InjectionResult:
        threads = [self.tracees.threads[tid] for tid in self.target.tids if tid in self.tracees.threads]
        low, high = self.target.call
        number = self.report.call = low + int(self.draw.integers(high - low + 1))
        if self.target.step is not None:
            self.report.precision, self.report.step = "exact", self.target.step
        elif self.target.cpu_s is None:
            threads = [self._rehearse(threads)]
        if number > 1 and len(threads) > 1:  # calls are those of one thread: whose comes first
            threads, number = [self._arrive(threads, 1)], number - 1
        thread = self._arrive(threads, number)
        frame = self._frame(thread)
        if self.report.step is None:
            return self._after(thread, frame)
        for taken in range(self.report.step):
            self._step(thread)
            if self._is_over(thread, frame):
                raise MissedError(
                    "not_reached",
                    f"the call had {taken + 1} instructions, the drawn one is number {self.report.step}",
                )
        return self._inject(thread, frame)

    def _rehearse(self, threads: list[Tracee]) -> Tracee:
        """Learn from one or two calls how long they are, and draw a place; whose calls they were."""
        thread = self._arrive(threads, 1)
        frame = self._frame(thread)
        with ThreadTimer(thread, _FOR_EVER_NS, self.tracees.notice) as timer:
            self._return(thread, frame)
            took_ns = timer.spent_ns
        self.report.rehearsals = 1
        self.report.cpu_ns = int(self.draw.random() * took_ns)
        if took_ns > SHORT_NS:
            return thread
        self._arrive([thread], 1)
        frame = self._frame(thread)
        self.report.rehearsals = 2
        for taken in range(1, MOST_STEPS + 1):
            self._step(thread)
            if self._is_over(thread, frame):
                self.report.precision, self.report.cpu_ns = "rehearsed", None
                self.report.instructions, self.report.step = taken, int(self.draw.integers(taken))
                return thread
        self._return(thread, frame)
        return thread

    def _arrive(self, threads: list[Tracee], hit: int) -> Tracee:
        """Let all run until one of some threads stands at the function's beginning, the ``hit``-th time."""
        for one in threads:
            if one.report is not None and self._address(one) == self.target.entry:
                self._step(one)
        with ExitStack() as held:
            for one in threads:
                held.enter_context(Breakpoint(one, self.target.entry, hit, self.tracees.notice))
            self.tracees.resume_all()
            thread = self._await(threads, lambda one: self._address(one) == self.target.entry)
        if thread is None:
            calls = "a call" if hit == 1 else f"{hit} calls"
            raise MissedError(
                "not_reached", f"the function was not reached within {self.target.limit_s:g} s ({calls})"
            )
        self.report.tid = thread.tid
        return thread

    def _return(self, thread: Tracee, frame: _Frame) -> None:
        with Breakpoint(thread, frame.returns_to, 1, self.tracees.notice):
            while not self._is_over(thread, frame):
                self.tracees.resume_all()
                if self._await([thread], lambda one: self._address(one) == frame.returns_to) is None:
                    limit = f"within {self.target.limit_s:g} s"
                    raise MissedError(
                        "not_reached", f"the function did not return {limit}: give --step or --cpu-s"
                    )

    def _frame(self, thread: Tracee) -> _Frame:
        stack = registers_of(thread).stack_pointer
        return _Frame(int.from_bytes(self.process.read_memory(stack, 8), "little"), stack)

    def _is_over(self, thread: Tracee, frame: _Frame) -> bool:
        return registers_of(thread).stack_pointer > frame.stack

    # -- by time ------------------------------------------------------------------------------------

    def _after(self, thread: Tracee, frame: _Frame | None) -> InjectionResult:
        """Inject after some thread time, in a call if one is given; again if it is in a system call then."""
        if self.report.cpu_ns is None:
            self.report.cpu_ns = round(self._between(self.target.cpu_s or CPU_S) * 1e9)
        cpu_ns = self.report.cpu_ns

        def attempt(met: int) -> InjectionResult | None:
            self._run_for(thread, 0 if met else cpu_ns, frame)
            self._jitter_within(thread, frame)
            return self._inject_once(thread, frame)

        return self._past_system_calls(attempt)

    def _in_a_library(self, thread: Tracee) -> InjectionResult:
        """Look at a thread every now and then until it is in the library."""
        wait_ns, looks = round(self._between(self.target.cpu_s or (0.0, 0.0)) * 1e9), 0
        while True:
            wait_ns += int(self.draw.integers(SAMPLE_NS))
            try:
                self._run_for(thread, wait_ns, None)
            except MissedError as error:
                if error.result.status != "not_reached":  # it ended
                    raise
                name = Path(self.target.code[0].path).name
                limit = f"in {self.target.limit_s:g} s"
                reason = f"thread {thread.tid} was seen executing {looks} times {limit}, never in {name}"
                raise MissedError("not_reached", reason) from error
            self._jitter_within(thread, None)
            wait_ns, looks = 0, looks + 1
            if self._is_inside(thread) and (found := self._inject_once(thread, None)) is not None:
                self.report.cpu_ns = None
                return replace(found, passed_over=found.passed_over + looks - 1)

    def _is_inside(self, thread: Tracee) -> bool:
        address = self._address(thread)
        return any(one.start <= address < one.end for one in self.target.code)

    def _run_for(self, thread: Tracee, cpu_ns: int, frame: _Frame | None) -> None:
        """Let all run until a thread has used some time, or its call is over."""
        with ExitStack() as held:
            timer = held.enter_context(ThreadTimer(thread, cpu_ns, self.tracees.notice))
            if frame is not None:
                held.enter_context(Breakpoint(thread, frame.returns_to, 1, self.tracees.notice))
            self.tracees.resume_all()
            if self._await([thread], lambda _: True, timer.insist) is None:
                used = f"used {timer.spent_ns / 1e9:.3g} s of processor time in {self.target.limit_s:g} s"
                raise MissedError("not_reached", f"thread {thread.tid} {used}")

    def _jitter_within(self, thread: Tracee, frame: _Frame | None) -> None:
        """Step on, but not out of the call: a timer does not trap at every instruction alike."""

        def check() -> None:
            if frame is not None and self._is_over(thread, frame):
                raise MissedError("not_reached", "the call ended before the drawn moment")

        self._jitter(thread, self.process, self._step, check)

    # -- at the injection point ---------------------------------------------------------------------

    def _inject(self, thread: Tracee, frame: _Frame) -> InjectionResult:

        def attempt(met: int) -> InjectionResult | None:
            if met:
                self.tracees.resume_others(thread)
                self._step(thread)
            return self._inject_once(thread, frame)

        return self._past_system_calls(attempt)

    def _inject_once(self, thread: Tracee, frame: _Frame | None) -> InjectionResult | None:
        def within(*details: object) -> InjectionResult | None:
            if frame is not None and self._is_over(thread, frame):
                raise MissedError("not_activated", "nothing eligible until the call ended")
            if self.target.code and not self._is_inside(thread):
                raise MissedError("not_activated", "nothing eligible until the library was left")
            return self.corruption(*details)  # type: ignore[arg-type]

        self.tracees.stop_all()
        return apply_fault(self.tracees, thread, self.process, self.fault, self.draw, within)

    def _step(self, thread: Tracee) -> None:
        end = self.tracees.step(thread)
        if end != "stepped":
            what = {"gone": "ended", "faulted": "raised a signal", "stuck": "waits in a system call"}
            raise MissedError("failed", f"before the fault: thread {thread.tid} {what.get(end, end)}")

    def _address(self, thread: Tracee) -> int:
        return registers_of(thread).program_counter

    def _thread(self, tid: int) -> Tracee:
        if tid not in self.tracees.threads:
            raise MissedError("failed", f"before the fault: thread {tid} ended")
        return self.tracees.threads[tid]

    def _await(
        self,
        threads: Sequence[Tracee],
        right: Callable[[Tracee], bool],
        insist: Callable[[], None] = lambda: None,
    ) -> Tracee | None:
        """Let all run until one of some threads stands where it is right; None after the time limit."""

        def look() -> Tracee | None:
            self.tracees.service()
            if not any(one.tid in self.tracees.threads for one in threads):
                raise MissedError("failed", "before the fault: the thread ended")
            for one in list(self.tracees.threads.values()):
                if one.report is not None and one.report.kind == "timer":
                    if one in threads and right(one):
                        return one
                    self.tracees.resume(one)
            insist()
            return None

        return wait_until(look, self._deadline - time.monotonic())

    def _wait(self, duration_s: float) -> None:
        """Let all run for some wall time."""
        end = time.monotonic() + duration_s

        def look() -> bool | None:
            self.tracees.service()
            return time.monotonic() >= end or None

        wait_until(look, duration_s + 1)

    def _between(self, bounds: tuple[float, float]) -> float:
        return bounds[0] + self.draw.random() * (bounds[1] - bounds[0])
