"""Approach in a process that does not cooperate: by function, by library, or by processor time.

No probe of it can be sent ahead, so earlier calls of the function are observed instead: the rehearsals.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from injector.attach.function_calls import (
    CalledFunction,
    CallFrame,
    FunctionCalls,
    address_of,
    step,
)
from injector.attach.untrapped_tracees import UntrappedTracees
from injector.faults.apply import apply_fault
from injector.faults.approach import Approach, MissedError
from injector.faults.corruption import Corruption
from injector.faults.stopped_thread import InjectionResult
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

CALLS_LEFT = 8
"""Calls that were left before they returned, after which no other one is observed."""

_FOR_EVER_NS = 10**15


@dataclass(frozen=True, slots=True)
class AttachTarget:
    """Where in a process to inject. Pairs are ranges, ends included, of which one value is drawn.

    A ``function``, or the ``code`` of a library (none: all). ``tids`` are the threads
    that come into question. ``call`` counts calls of the function from 1; ``step`` names the instruction of
    the call, ``cpu_s`` thread time after its beginning, or from now on. ``after_s`` is wall time before all
    that.
    """

    tids: tuple[int, ...]
    function: CalledFunction | None = None
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
    missed: int = 0


class CallOverError(MissedError):
    """A call was over before the drawn moment, or before something came that can be struck."""


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
    _took_ns: int = 0

    @cached_property
    def _calls(self) -> FunctionCalls:
        assert self.target.function is not None  # noqa: S101 - what is asked for is a call of one
        return FunctionCalls(self.tracees, self.process, self.target.function, self.target.limit_s)

    def _run(self) -> InjectionResult:
        self._deadline = time.monotonic() + self.target.limit_s + self.target.after_s[1]
        self.report.tid = self.target.tids[0]
        self._wait(self._between(self.target.after_s))
        if self.target.function is not None:
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
        thread = self._arrive(threads, number)
        if self._took_ns:
            return self._at_a_moment(thread)
        frame = self._calls.frame(thread)
        if self.report.step is None:
            return self._after(thread, frame)
        for taken in range(self.report.step):
            self._step(thread)
            if FunctionCalls.is_over(thread, frame):
                raise MissedError(
                    "not_reached",
                    f"the call had {taken + 1} instructions, the drawn one is number {self.report.step}",
                )
        return self._inject(thread, frame)

    def _rehearse(self, threads: list[Tracee]) -> Tracee:
        """Learn from one or two calls how long they are, and draw a place; whose calls they were."""
        thread, took_ns = self._timed(threads)
        if took_ns <= SHORT_NS and self._stepped_through(thread):
            return thread
        self._took_ns = took_ns
        return thread

    def _timed(self, threads: list[Tracee]) -> tuple[Tracee, int]:
        """A call that returned, and the thread time that it took; those that were left are passed over."""
        for _ in range(CALLS_LEFT):
            thread = self._arrive(threads, 1)
            frame = self._calls.frame(thread)
            self.report.rehearsals += 1
            with ThreadTimer(thread, _FOR_EVER_NS, self.tracees.notice) as timer:
                if self._calls.complete(thread, frame):
                    return thread, timer.spent_ns
        reason = f"{CALLS_LEFT} calls in a row were left by a jump or an exception: give --step or --cpu-s"
        raise MissedError("not_reached", reason)

    def _stepped_through(self, thread: Tracee) -> bool:
        """Step through a call and draw one of its instructions; False if there are too many."""
        self._arrive([thread], 1)
        frame = self._calls.frame(thread)
        self.report.rehearsals += 1
        for taken in range(1, MOST_STEPS + 1):
            self._step(thread)
            if FunctionCalls.is_over(thread, frame):
                self.report.precision = "rehearsed"
                self.report.instructions, self.report.step = taken, int(self.draw.integers(taken))
                return True
        self._calls.complete(thread, frame)
        return False

    def _at_a_moment(self, thread: Tracee) -> InjectionResult:
        """Inject at a drawn moment of a call; if that is over before, of the next one."""
        while True:
            self.report.cpu_ns = int(self.draw.random() * self._took_ns)
            try:
                return self._after(thread, self._calls.frame(thread))
            except CallOverError:
                self.report.missed += 1
                self.report.call += 1
            thread = self._arrive([thread], 1)

    def _arrive(self, threads: list[Tracee], number: int) -> Tracee:
        thread = self._calls.arrive(threads, number)
        self.report.tid = thread.tid
        return thread

    # -- by time ------------------------------------------------------------------------------------

    def _after(self, thread: Tracee, frame: CallFrame | None) -> InjectionResult:
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
        address = address_of(thread)
        return any(one.start <= address < one.end for one in self.target.code)

    def _run_for(self, thread: Tracee, cpu_ns: int, frame: CallFrame | None) -> None:
        """Let all run until a thread has used some time, or its call is over."""
        with ExitStack() as held:
            timer = held.enter_context(ThreadTimer(thread, cpu_ns, self.tracees.notice))
            if frame is not None:
                held.enter_context(Breakpoint(thread, frame.returns_to, 1, self.tracees.notice))

            def insist() -> None:
                timer.insist()
                if frame is not None and self._calls.is_left_asleep(thread, frame):
                    raise CallOverError("not_reached", "the call was left, and its thread waits elsewhere")

            self.tracees.resume_all()
            if self.tracees.await_one([thread], lambda _: True, self._deadline, insist) is None:
                used = f"used {timer.spent_ns / 1e9:.3g} s of processor time in {self.target.limit_s:g} s"
                raise MissedError("not_reached", f"thread {thread.tid} {used}")

    def _jitter_within(self, thread: Tracee, frame: CallFrame | None) -> None:
        """Step on, but not out of the call: a timer does not trap at every instruction alike."""

        def check() -> None:
            if frame is not None and FunctionCalls.is_over(thread, frame):
                raise CallOverError("not_reached", "the call ended before the drawn moment")

        self._jitter(thread, self.process, self._step, check)

    # -- at the injection point ---------------------------------------------------------------------

    def _inject(self, thread: Tracee, frame: CallFrame) -> InjectionResult:

        def attempt(met: int) -> InjectionResult | None:
            if met:
                self.tracees.resume_others(thread)
                self._step(thread)
            return self._inject_once(thread, frame)

        return self._past_system_calls(attempt)

    def _inject_once(self, thread: Tracee, frame: CallFrame | None) -> InjectionResult | None:
        def within(*details: object) -> InjectionResult | None:
            if frame is not None and FunctionCalls.is_over(thread, frame):
                raise CallOverError("not_activated", "nothing eligible until the call ended")
            if self.target.code and not self._is_inside(thread):
                raise MissedError("not_activated", "nothing eligible until the library was left")
            return self.corruption(*details)  # type: ignore[arg-type]

        self.tracees.stop_all()
        return apply_fault(self.tracees, thread, self.process, self.fault, self.draw, within)

    def _step(self, thread: Tracee) -> None:
        step(self.tracees, thread)

    def _thread(self, tid: int) -> Tracee:
        if tid not in self.tracees.threads:
            raise MissedError("failed", f"before the fault: thread {tid} ended")
        return self.tracees.threads[tid]

    def _wait(self, duration_s: float) -> None:
        """Let all run for some wall time."""
        end = time.monotonic() + duration_s

        def look() -> bool | None:
            self.tracees.service()
            return time.monotonic() >= end or None

        wait_until(look, duration_s + 1)

    def _between(self, bounds: tuple[float, float]) -> float:
        return bounds[0] + self.draw.random() * (bounds[1] - bounds[0])
