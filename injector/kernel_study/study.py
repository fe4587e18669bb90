"""The kernel study: what one fault does to a kernel alone, thousands of times (the paper's Fig. 6).

A worker holds a kernel on its recorded sample (:mod:`injector.kernel_study.subject`). It takes a copy through
the call once for many injections; at each drawn instruction another copy is made
(:mod:`injector.kernel_study.checkpoints`), a fault is injected, and it runs to its end. The worker is the
copies' parent and tracer: they die with it, and nothing of a fault outlives its injection.

Instructions are drawn by the law of flights (docs/internals/sampling.md).
"""

from __future__ import annotations

import os
import signal
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from injector.block_profile.counted_call import UncountableError
from injector.block_profile.instruction_counts import draw_instruction
from injector.faults.apply import apply_fault
from injector.faults.call_profile import CallProfile
from injector.faults.record import exact_site, record_of
from injector.faults.stopped_thread import InjectionResult
from injector.kernel_study.checkpoints import CheckpointRun
from injector.kernel_study.remote_fork import RemoteForkError, RemoteForks
from injector.kernel_study.results import CallLength, SamplePoint, StudyResult, StudyRun
from injector.kernel_study.subject import MARK, Subject
from injector.tracing import elf, ptrace
from injector.tracing.compiled_functions import CompiledFunctions
from injector.tracing.process import MemoryMap, Process, ProcessIdentity, VanishedError, cpu_s, sleeps
from injector.tracing.ptrace import GoneError, StopReport
from injector.tracing.source_lines import SourceLines
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from injector.tracing.waiting import wait_until
from services.models.faults.specification import FaultSpec, Trigger
from services.models.outcome import InjectionRecord
from services.runtime import rng
from services.system.signal_names import signal_name

HANG_TIMES = 10
"""A copy that uses this many times the thread time of a good call, and ..."""

HANG_MARGIN_S = 0.05
"""... this much more, hangs."""

ASLEEP_LOOKS = 5
"""Looks at which a copy sleeps before it is taken to wait for ever: nobody else is there to wake it.

They need not be in a row. Who waits for the interpreter's lock, which it holds itself, wakes every 5 ms.
"""

GOLDEN_CALLS = 5
"""Calls without a fault whose median thread time is that of a golden call."""

LOST = InjectionResult("failed", "what was to be struck was lost before the fault")
"""Somebody else killed or stopped it."""

_LOOK_S = 0.01
_BEGIN_S = 20.0


class SubjectInjector:
    """Injects into copies of one subject, one after the other. Only in a process of one thread.

    ``root`` stands at the beginning of the call; ``forks`` makes copies of it.
    """

    def __init__(self, kernel: str, subject: Subject, pid: int, tracees: TraceeGroup) -> None:
        """Take over the process that ``subject`` forked, which stands at the beginning of its call."""
        self._kernel, self._subject, self.tracees = kernel, subject, tracees
        self.root = tracees.threads[pid]
        self.forks = RemoteForks(tracees)
        # The same in all copies.
        self._compiled = CompiledFunctions()
        self._places = elf.CodeLocations(
            pid, MemoryMap(Path(f"/proc/{pid}/maps").read_text()), self._compiled, SourceLines()
        )
        self._profiled: tuple[FaultSpec, CallProfile] | None = None
        self._limit_s = _BEGIN_S
        took_s = sorted(self._golden_call_s() for _ in range(GOLDEN_CALLS))[GOLDEN_CALLS // 2]
        self._limit_s = HANG_TIMES * took_s + HANG_MARGIN_S

    def draw(
        self, fault: FaultSpec, seed: int, indices: Sequence[int]
    ) -> tuple[CallLength, list[SamplePoint]]:
        """Draw injections: how long the call is, and the instructions in the order in which it executes them.

        None are drawn if the fault can strike none.

        :raises UncountableError, CheckpointError, RemoteForkError, GoneError: if we cannot.
        """
        profile = self._profile(fault)
        stream = f"instruction {self._kernel}"
        points = []
        for index in indices:
            draw = rng.generator(seed, stream, index)
            drawn = draw_instruction(profile.eligible, lambda _: True, draw)
            if drawn is not None:
                points.append(SamplePoint(index=index, address=drawn.address, hit=drawn.hit))
        length = CallLength(
            scope=profile.counts.executed, eligible=profile.eligible.executed, all=self._thread_length()
        )
        return length, self._checkpoints(fault).in_order(points)

    def run(self, leg: Sequence[SamplePoint], fault: FaultSpec, seed: int) -> Iterator[tuple[int, StudyRun]]:
        """Inject into a copy at each point of a leg, which is in the call's order: number, what came of it.

        Where somebody else kills or stops what is to be struck, the point is told of as not injected. If no
        copy could be made there, one goes through the call anew for the rest of the leg.

        :raises UncountableError, CheckpointError, RemoteForkError, GoneError: if we cannot.
        """
        left = list(leg)
        while left:
            with closing(self._visit(left, fault, seed)) as runs:
                for index, run in runs:
                    left.pop(0)
                    yield index, run

    def _visit(
        self, leg: Sequence[SamplePoint], fault: FaultSpec, seed: int
    ) -> Generator[tuple[int, StudyRun]]:
        """Inject at each of the points, up to the first at which no copy can be made."""
        with closing(self._checkpoints(fault).visit(tuple(leg))) as points:
            for point, there, _ in points:
                aimed = fault.model_copy(update={"seed": point.index, "trigger": self._trigger(point)})
                try:
                    copy = self.forks.copy(there)
                except RemoteForkError:
                    yield point.index, self._told(point, aimed, LOST, None)
                    return
                yield point.index, self._inject(point, copy, aimed, seed)

    def _checkpoints(self, fault: FaultSpec) -> CheckpointRun:
        leaders = self._profile(fault).counts.leaders
        return CheckpointRun(self.tracees, self.forks, self.root, MARK, fault, leaders)

    def _profile(self, fault: FaultSpec) -> CallProfile:
        if self._profiled is None or self._profiled[0] != fault:
            self._profiled = (fault, self._counted(fault))
        return self._profiled[1]

    def _counted(self, fault: FaultSpec) -> CallProfile:
        copy = self.forks.copy(self.root)
        try:
            with Process(ProcessIdentity.of(copy.pid)) as process:
                return CallProfile(copy, process, fault, MARK, self._compiled)
        finally:
            self.forks.end(copy)

    def _thread_length(self) -> int | None:
        """How many instructions the call's thread executes in all code; None if that cannot be counted."""
        try:
            return self._counted(FaultSpec(target=self._kernel, scope="thread")).counts.executed
        except UncountableError:
            return None

    def _inject(self, point: SamplePoint, copy: Tracee, aimed: FaultSpec, seed: int) -> StudyRun:
        draw = rng.generator(seed, f"study {self._kernel}", point.index)
        before = set(self.tracees.threads) - {copy.tid}
        self._subject.forget()
        try:
            try:
                with Process(ProcessIdentity.of(copy.pid)) as process:
                    found = apply_fault(self.tracees, copy, process, aimed, draw)
            except VanishedError:
                found = LOST
            if found is None:
                found = InjectionResult("not_activated", "the place is a system call")
            end = self._finish(copy) if found.bits else None
        finally:
            for one in [one for one in self.tracees.threads.values() if one.tid not in before]:
                self.forks.end(one)  # it hangs, or what it has started does
        return self._told(point, aimed, found, end)

    def _finish(self, copy: Tracee) -> StopReport | None:
        """Let a copy run to its end: how it ended, None if it hangs."""
        if copy.tid not in self.tracees.threads:
            return StopReport("gone", signal.SIGKILL)
        self.tracees.resume(copy)
        asleep = 0
        while True:
            report = ptrace.poll(copy.tid)
            if report is None:
                if not signal.sigtimedwait({signal.SIGCHLD}, _LOOK_S):
                    asleep += sleeps(copy.tid)
                    if asleep >= ASLEEP_LOOKS or cpu_s(copy.pid) > self._limit_s:
                        return None
            elif report.kind == "gone":
                del self.tracees.threads[copy.tid]
                return report
            elif report.kind in ("step", "timer"):
                return StopReport("gone", signal.SIGTRAP)  # a trap of its own making
            elif report.kind == "group_stop":
                return None
            else:
                self._go_on(copy, report)

    def _go_on(self, copy: Tracee, report: StopReport) -> None:
        """Past a signal, which it gets unless it is its mark; what it starts stands where it begins."""
        with suppress(GoneError):  # killed meanwhile; its end is reported next
            if report.kind in ("new_thread", "new_process"):
                tid = ptrace.started(copy.tid)
                pid = copy.pid if report.kind == "new_thread" else tid
                self.tracees.threads[tid] = Tracee(pid, tid)
            deliver = report.kind == "signal" and report.signal != MARK
            ptrace.resume(copy.tid, report.signal if deliver else 0)

    def _told(
        self, point: SamplePoint, fault: FaultSpec, found: InjectionResult, end: StopReport | None
    ) -> StudyRun:
        result, cause = self._judge(fault, found, end)
        made = self._subject.made() if result == "sdc" else None
        return StudyRun(
            kernel=self._kernel,
            index=point.index,
            result=result,
            within_tolerance=made is not None and made.within_tolerance,
            deviation=None if made is None else made.deviation,
            cause=cause,
            injection=self._record(fault, found),
        )

    def _judge(
        self, fault: FaultSpec, found: InjectionResult, end: StopReport | None
    ) -> tuple[StudyResult, str]:
        dummy = fault.model == "none" and bool(found.bits)
        if found.status != "injected" and not dummy:
            return "not_injected", found.reason
        if end is None:
            return "hang", ""
        if end.signal:
            return "crash", signal_name(end.signal)
        what = self._subject.made().what
        if end.exit_status or what == "nothing":
            return "crash", "exception" if end.exit_status else "it ended early"
        return ("benign" if what == "golden" else "sdc"), ""

    def close(self) -> None:
        """Kill the subject's process and every copy."""
        for one in list(self.tracees.threads.values()):
            self.forks.end(one)

    # -- what is told of it ------------------------------------------------------------------------

    def _trigger(self, point: SamplePoint) -> Trigger:
        return Trigger(invocation=0, site=exact_site(self._places.at(point.address), point.hit))

    def _record(self, fault: FaultSpec, found: InjectionResult) -> InjectionRecord:
        assert fault.trigger is not None  # noqa: S101 - made above
        assert fault.trigger.site is not None  # noqa: S101
        return record_of(
            found,
            fault,
            node=self._kernel,
            kernel=self._kernel,
            invocation=0,
            location=self._places.at,
            precision=fault.trigger.site.precision,
            trigger=fault.trigger,
            threads_stopped=1,
        )

    # -- the good call -----------------------------------------------------------------------------

    def _golden_call_s(self) -> float:
        """The thread time of a call without a fault in a copy, s.

        :raises RuntimeError: if a copy without a fault does not make the golden output.
        """
        copy = self.forks.copy(self.root)
        self._subject.forget()
        end, made = self._finish(copy), self._subject.made()
        if end is None or made.what != "golden":
            message = f"{self._kernel}: a copy that was left alone made another output ({end})"
            raise RuntimeError(message)
        return made.spent_ns / 1e9


@contextmanager
def at_the_beginning(kernel: str, pid: int, go: int) -> Iterator[TraceeGroup]:
    """The process that a subject forked, traced by us, at the beginning of its call.

    :raises RuntimeError: if it does not come there.
    """
    with TraceeGroup(MARK, forks=True, ours=True) as tracees:
        tracees.seize([pid])
        os.write(go, b"x")

        def there() -> bool | None:
            tracees.service()
            return True if tracees.threads[pid].report is not None else None

        if not wait_until(there, _BEGIN_S):
            message = f"{kernel}: the process to be copied never began its call"
            raise RuntimeError(message)
        yield tracees


@contextmanager
def subject_injector(kernel: str, subject: Subject, pid: int, go: int) -> Iterator[SubjectInjector]:
    """An injector for copies of the process that ``subject`` forked; it and they are gone afterwards.

    :raises RuntimeError: if the call is not the same in a copy.
    """
    with at_the_beginning(kernel, pid, go) as tracees:
        injector = SubjectInjector(kernel, subject, pid, tracees)
        try:
            yield injector
        finally:
            injector.close()
