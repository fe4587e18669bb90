"""Approach in a process that does not cooperate: by library, or by processor time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
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

CPU_S = (0.0, 0.01)
"""Thread time within which a fault is injected, if nothing else is asked for."""

SAMPLE_NS = 1_000_000
"""Most thread time between two looks at whether a thread is in a library."""


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
    hit: int | None = None
    uncounted: str = ""


class CallOverError(MissedError):
    """A call was over before the drawn moment, or before something came that can be struck."""


@dataclass
class AttachApproach(Approach):
    """Brings a thread of any process to the injection point. ``report`` tells how far it came.

    ``asked`` is the fault that was asked for, ``fault`` what is done: in a dry run nothing.
    """

    DIED = "the process ended before the fault"

    tracees: UntrappedTracees
    process: Process
    target: AttachTarget
    fault: FaultSpec
    asked: FaultSpec
    corruption: Corruption
    draw: np.random.Generator
    report: ApproachReport = field(default_factory=ApproachReport)
    _deadline: float = 0.0

    def _run(self) -> InjectionResult:
        self._deadline = time.monotonic() + self.target.limit_s + self.target.after_s[1]
        self.report.tid = self.target.tids[0]
        self._wait(self._between(self.target.after_s))
        return self._strike()

    def _strike(self) -> InjectionResult:
        thread = self._thread(self.target.tids[0])
        return self._in_a_library(thread) if self.target.code else self._after(thread, None)

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
                if frame is not None:
                    self._check_asleep(thread, frame)

            self.tracees.resume_all()
            if self.tracees.await_one([thread], lambda _: True, self._deadline, insist) is None:
                used = f"used {timer.spent_ns / 1e9:.3g} s of processor time in {self.target.limit_s:g} s"
                raise MissedError("not_reached", f"thread {thread.tid} {used}")

    def _check_asleep(self, thread: Tracee, frame: CallFrame) -> None:
        """Raise an error if a thread waits in the kernel outside of a call of its own."""

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
