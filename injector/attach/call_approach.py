"""Approach to a call of a function in a process that does not cooperate.

No probe of it can be sent ahead, so earlier calls are observed: the rehearsals. Of one that is too long to
step through, copies are counted at its beginning.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property

from injector.attach.approach import AttachApproach, CallOverError
from injector.attach.counted_copy import CallCounter, CountedPlace, EndlessCopyError
from injector.attach.function_calls import CallFrame, FunctionCalls, address_of
from injector.block_profile.counted_call import UncountableError
from injector.faults.approach import MissedError
from injector.faults.stopped_thread import InjectionResult
from injector.tracing.perf_events import Breakpoint, ThreadTimer
from injector.tracing.tracee import Tracee

SHORT_NS = 2_000_000
"""Longest thread time of a call that is stepped through."""

FEW_STEPS = 2_000
"""Instructions after which a call is rather counted in a copy: a tenth of a second of wall time."""

MOST_STEPS = 20_000
"""Instructions after which a call counts as too long to step through: a second of wall time."""

PASS_S = 1e-5
"""Wall time that it takes to count a pass through an instruction."""

COUNTED_CALLS = 3
"""Calls that could not be counted, after which a moment is drawn."""

CALLS_LEFT = 8
"""Calls that were left before they returned, after which no other one is observed."""

_FOR_EVER_NS = 10**15


@dataclass
class CallApproach(AttachApproach):
    """Brings a thread of any process to an instruction of a call of the target's function."""

    @cached_property
    def _calls(self) -> FunctionCalls:
        assert self.target.function is not None  # noqa: S101 - what is asked for is a call of one
        return FunctionCalls(self.tracees, self.process, self.target.function, self.target.limit_s)

    def _strike(self) -> InjectionResult:
        threads = [self.tracees.threads[tid] for tid in self.target.tids if tid in self.tracees.threads]
        low, high = self.target.call
        number = self.report.call = low + int(self.draw.integers(high - low + 1))
        if self.target.step is not None:
            self.report.precision, self.report.step = "exact", self.target.step
        elif self.target.cpu_s is None:
            thread, took_ns = self._timed(threads)
            threads = [thread]
            if took_ns > SHORT_NS or not self._stepped_through(thread, FEW_STEPS):
                return self._in_a_long_call(self._arrive(threads, number), took_ns)
        thread = self._arrive(threads, number)
        if self.report.step is not None:
            return self._at_step(thread)
        return self._after(thread, self._frame(thread))

    def _at_step(self, thread: Tracee) -> InjectionResult:
        frame = self._frame(thread)
        for taken in range(self.report.step or 0):
            self._step(thread)
            if FunctionCalls.is_over(thread, frame):
                raise MissedError(
                    "not_reached",
                    f"the call had {taken + 1} instructions, the drawn one is number {self.report.step}",
                )
        return self._inject(thread, frame)

    def _timed(self, threads: list[Tracee]) -> tuple[Tracee, int]:
        """A call that returned, and the thread time that it took; those that were left are passed over."""
        for _ in range(CALLS_LEFT):
            thread = self._arrive(threads, 1)
            frame = self._frame(thread)
            self.report.rehearsals += 1
            with ThreadTimer(thread, _FOR_EVER_NS, self.tracees.notice) as timer:
                if self._calls.complete(thread, frame):
                    return thread, timer.spent_ns
        reason = f"{CALLS_LEFT} calls in a row were left by a jump or an exception: give --step or --cpu-s"
        raise MissedError("not_reached", reason)

    def _stepped_through(self, thread: Tracee, most: int) -> bool:
        """Step through a call and draw one of its instructions; False if there are more than ``most``."""
        self._arrive([thread], 1)
        frame = self._frame(thread)
        self.report.rehearsals += 1
        for taken in range(1, most + 1):
            self._step(thread)
            if FunctionCalls.is_over(thread, frame):
                self.report.precision, self.report.uncounted = "rehearsed", ""
                self.report.instructions, self.report.step = taken, int(self.draw.integers(taken))
                return True
        self._calls.complete(thread, frame)
        return False

    def _in_a_long_call(self, thread: Tracee, took_ns: int) -> InjectionResult:
        """Inject at an instruction drawn from counts of the very call; if none is counted, as is possible."""
        uncounted = 0
        while uncounted < COUNTED_CALLS:
            frame = self._frame(thread)
            try:
                counter = CallCounter(self.tracees, thread, self.process, frame, self.asked, took_ns)
                return self._at_place(thread, frame, counter.draw(self.draw), took_ns)
            except UncountableError as error:
                self.report.uncounted = str(error)
                uncounted += COUNTED_CALLS if isinstance(error, EndlessCopyError) else 1
            except CallOverError:  # it went another way than its copy
                self.report.missed += 1
            self.report.call += 1
            thread = self._arrive([thread], 1)
        if took_ns <= SHORT_NS and self._stepped_through(thread, MOST_STEPS):
            return self._at_step(self._arrive([thread], 1))
        return self._at_a_moment(self._arrive([thread], 1), took_ns)

    def _at_place(
        self, thread: Tracee, frame: CallFrame, place: CountedPlace | None, took_ns: int
    ) -> InjectionResult:
        """Inject at an instruction of the call at whose beginning a thread stands."""
        self.report.precision, self.report.uncounted = "exact", ""
        if place is None:
            raise MissedError("not_activated", "the call executes nothing that the fault can strike")
        drawn, way = place.instruction, place.way
        self.report.instructions, self.report.hit = place.executed, drawn.hit
        if place.passes * PASS_S > self._deadline - time.monotonic():
            self.report.precision = "cpu_time"
            self.report.uncounted = f"{place.passes} passes to count take longer than the limit"
            self.report.cpu_ns = round(took_ns * drawn.hit / drawn.passes)
            return self._after(thread, frame)
        if way is not None:
            self._pass_through(thread, frame, way.address, way.hit)
        self._pass_through(thread, frame, drawn.address, way.rest if way is not None else drawn.hit)
        return self._inject(thread, frame)

    def _pass_through(self, thread: Tracee, frame: CallFrame, address: int, hit: int) -> None:
        """Run to a pass through an address, the ``hit``-th from here on."""
        if address_of(thread) == address:
            if hit == 1:
                return
            # Processors do not agree on whether a breakpoint counts where one stands.
            self._step(thread)
            hit -= 1
        with ExitStack() as held:
            passes = held.enter_context(Breakpoint(thread, address, hit, self.tracees.notice))
            if address != frame.returns_to:
                held.enter_context(Breakpoint(thread, frame.returns_to, 1, self.tracees.notice))
            self.tracees.resume_all()
            found = self.tracees.await_one(
                [thread],
                lambda one: passes.hits >= hit or FunctionCalls.is_over(one, frame),
                self._deadline,
                lambda: self._check_asleep(thread, frame),
            )
            if found is None:
                reason = f"{passes.hits} of {hit} passes through the drawn instruction"
                raise MissedError("not_reached", f"{reason} in {self.target.limit_s:g} s: give --limit-s")
        if FunctionCalls.is_over(thread, frame):
            raise CallOverError("not_reached", "the call ended before the drawn instruction")

    def _at_a_moment(self, thread: Tracee, took_ns: int) -> InjectionResult:
        """Inject at a drawn moment of a call; if that is over before, of the next one."""
        self.report.precision, self.report.instructions, self.report.hit = "cpu_time", None, None
        while True:
            self.report.cpu_ns = int(self.draw.random() * took_ns)
            try:
                return self._after(thread, self._frame(thread))
            except CallOverError:
                self.report.missed += 1
                self.report.call += 1
            thread = self._arrive([thread], 1)

    def _frame(self, thread: Tracee) -> CallFrame:
        return self._calls.frame(thread)

    def _arrive(self, threads: list[Tracee], number: int) -> Tracee:
        thread = self._calls.arrive(threads, number)
        self.report.tid = thread.tid
        return thread

    def _check_asleep(self, thread: Tracee, frame: CallFrame) -> None:
        if self._calls.is_left_asleep(thread, frame):
            raise CallOverError("not_reached", "the call was left, and its thread waits elsewhere")
