"""The kernel study: what one fault does to a kernel alone, thousands of times (the paper's Fig. 6).

A worker holds a kernel on its recorded sample (:mod:`injector.subject`). It takes a copy through the call
once for many injections; at each drawn place another copy is made (:mod:`injector.sweep`), struck, and run
to its end. The worker is the copies' parent and tracer: they die with it, and nothing of a fault outlives
its injection.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Literal

from injector import elf, ptrace
from injector.clock import Clock
from injector.copies import Copies, CopyError
from injector.freeze import Tracees
from injector.inject import Strike
from injector.process import Identity, Maps, Process, VanishedError, sleeps
from injector.ptrace import GoneError, Report, wait_until
from injector.strike import strike
from injector.subject import MARK, Subject
from injector.survey import Asked, Surveyor, Told
from injector.sweep import BEGINNING, Place, Sweep
from injector.thread import Thread
from services.bus import rng
from services.bus.mission import FaultSpec, Site, Trigger
from services.bus.model import Strict
from services.bus.outcome import InjectionRecord

StudyResult = Literal["benign", "sdc", "crash", "hang", "not_injected"]

HANG_TIMES = 10
"""A copy that uses this many times the thread time of a good call, and ..."""

HANG_MARGIN_S = 0.05
"""... this much more, hangs."""

ASLEEP_LOOKS = 5
"""Looks at which a copy sleeps before it is taken to wait for ever: nobody else is there to wake it.

They need not be in a row. Who waits for the interpreter's lock, which it holds itself, wakes every 5 ms.
"""

REHEARSALS = 5
"""Good calls by which the thread time of a call is known."""

LOST = Strike("failed", "what was to be struck was lost before the fault")
"""Somebody else killed or stopped it."""

_LOOK_S = 0.01
_BEGIN_S = 20.0


class StudyRun(Strict):
    """One injection into a kernel alone.

    ``sdc``: the output differs in a bit; ``within_tolerance`` says whether by no more than matters, and
    ``deviation`` by how much in the kernel's unit (None: it has more or fewer values, or not all are
    numbers). ``cause``: of a crash, the signal or "exception". Pid, tid and pause of the record are 0, as
    they tell nothing of a copy; the rest is the same in every run.
    """

    kernel: str
    index: int
    result: StudyResult
    within_tolerance: bool = False
    deviation: float | None = None
    cause: str = ""
    injection: InjectionRecord


class Task(Strict):
    """What a worker is asked for: a part of a ``survey``, or the strikes of a leg."""

    survey: Asked | None = None
    fault: FaultSpec | None = None
    seed: int = 0
    clock: Clock | None = None
    leg: tuple[Place, ...] = ()


class Answer(Strict):
    """One line of a worker: what it found, what came of a place (``refused``: its number), our own problem.

    The last one to a task has the processor time that worker and copies have used so far.
    """

    found: Told | None = None
    run: StudyRun | None = None
    refused: int | None = None
    problem: str = ""
    cpu_s: float | None = None


class Strikes:
    """Copies of one subject, struck one after the other. Only in a process of one thread."""

    def __init__(self, kernel: str, subject: Subject, pid: int, tracees: Tracees) -> None:
        """Take over the process that ``subject`` forked, which stands at the beginning of its call."""
        self._kernel, self._subject, self._tracees = kernel, subject, tracees
        self._root = tracees.threads[pid]
        self._copies = Copies(tracees)
        # The same in all copies.
        self._places = elf.Places(pid, Maps(Path(f"/proc/{pid}/maps").read_text()))
        self.surveyor = Surveyor(tracees, self._copies, self._root, MARK)
        self._limit_s = _BEGIN_S
        took_s = sorted(self._rehearse() for _ in range(REHEARSALS))[REHEARSALS // 2]
        self._limit_s = HANG_TIMES * took_s + HANG_MARGIN_S

    def run(
        self, clock: Clock, leg: Sequence[Place], fault: FaultSpec, seed: int
    ) -> Iterator[tuple[int, StudyRun | None]]:
        """Strike a copy at each of the places: number and what came of it, None where it was refused.

        Where somebody else kills or stops what is to be struck, the place is told of as not injected. If no
        copy could be made there, one goes through the call anew for the rest of the leg.

        :raises ClockError, CopyError: if we cannot.
        """
        left = {place.index: place for place in leg}
        while left:
            with closing(self._sweep(clock, list(left.values()), fault, seed)) as struck:
                for index, run in struck:
                    del left[index]
                    yield index, run

    def _sweep(
        self, clock: Clock, leg: Sequence[Place], fault: FaultSpec, seed: int
    ) -> Generator[tuple[int, StudyRun | None]]:
        """Strike at each of the places, up to the first at which no copy can be made."""
        with closing(Sweep(self._tracees, self._copies, self._root, clock).visit(leg)) as places:
            for place, there in places:
                if there is None:
                    yield place.index, None
                    continue
                aimed = fault.model_copy(update={"seed": place.index, "trigger": self._trigger(place, clock)})
                try:
                    copy = self._copies.copy(there)
                except CopyError:
                    yield place.index, self._told(place, aimed, LOST, None)
                    return
                yield place.index, self._strike(place, copy, aimed, seed)

    def _strike(self, place: Place, copy: Thread, aimed: FaultSpec, seed: int) -> StudyRun:
        draw = rng.generator(seed, f"study {self._kernel}", place.index)
        before = set(self._tracees.threads) - {copy.tid}
        self._subject.forget()
        try:
            try:
                with Process(Identity.of(copy.pid)) as process:
                    found = strike(self._tracees, copy, process, aimed, draw)
            except VanishedError:
                found = LOST
            if found is None:
                found = Strike("not_activated", "the place is a system call")
            end = self._finish(copy) if found.bits else None
        finally:
            for one in [one for one in self._tracees.threads.values() if one.tid not in before]:
                self._copies.end(one)  # it hangs, or what it has started does
        return self._told(place, aimed, found, end)

    def _finish(self, copy: Thread) -> Report | None:
        """Let a copy run to its end: how it ended, None if it hangs."""
        if copy.tid not in self._tracees.threads:
            return Report("gone", signal.SIGKILL)
        self._tracees.resume(copy)
        asleep = 0
        while True:
            report = ptrace.poll(copy.tid)
            if report is None:
                if not signal.sigtimedwait({signal.SIGCHLD}, _LOOK_S):
                    asleep += sleeps(copy.tid)
                    if asleep >= ASLEEP_LOOKS or _cpu_s(copy.pid) > self._limit_s:
                        return None
            elif report.kind == "gone":
                del self._tracees.threads[copy.tid]
                return report
            elif report.kind in ("step", "timer"):
                return Report("gone", signal.SIGTRAP)  # a trap of its own making
            elif report.kind == "group_stop":
                return None
            else:
                self._go_on(copy, report)

    def _go_on(self, copy: Thread, report: Report) -> None:
        """Past a signal, which it gets unless it is its mark; what it starts stands where it begins."""
        with suppress(GoneError):  # killed meanwhile; its end is reported next
            if report.kind in ("new_thread", "new_process"):
                tid = ptrace.started(copy.tid)
                pid = copy.pid if report.kind == "new_thread" else tid
                self._tracees.threads[tid] = Thread(pid, tid)
            deliver = report.kind == "signal" and report.signal != MARK
            ptrace.resume(copy.tid, report.signal if deliver else 0)

    def _told(self, place: Place, fault: FaultSpec, found: Strike, end: Report | None) -> StudyRun:
        result, cause = self._judge(fault, found, end)
        made = self._subject.made() if result == "sdc" else None
        return StudyRun(
            kernel=self._kernel,
            index=place.index,
            result=result,
            within_tolerance=made is not None and made.within_tolerance,
            deviation=None if made is None else made.deviation,
            cause=cause,
            injection=self._record(fault, found),
        )

    def _judge(self, fault: FaultSpec, found: Strike, end: Report | None) -> tuple[StudyResult, str]:
        dummy = fault.model == "none" and bool(found.bits)
        if found.status != "injected" and not dummy:
            return "not_injected", found.reason
        if end is None:
            return "hang", ""
        if end.signal:
            return "crash", signal.Signals(end.signal).name
        what = self._subject.made().what
        if end.exit_status or what == "nothing":
            return "crash", "exception" if end.exit_status else "it ended early"
        return ("benign" if what == "golden" else "sdc"), ""

    def close(self) -> None:
        """End every process."""
        for one in list(self._tracees.threads.values()):
            self._copies.end(one)

    # -- what is told of it ------------------------------------------------------------------------

    def _trigger(self, place: Place, clock: Clock) -> Trigger:
        if place.anchor == BEGINNING:
            exact = not clock.anchors
            site = Site(
                rung="exact" if exact else "occurrence",
                step=place.step if exact else None,
                steps=place.step,
            )
        else:
            where = self._places.at(clock.anchors[place.anchor].address)
            site = Site(
                rung="occurrence",
                module=where.module,
                build_id=where.build_id,
                offset=where.offset,
                hit=place.hit,
                steps=place.step,
            )
        return Trigger(invocation=0, site=site)

    def _record(self, fault: FaultSpec, found: Strike) -> InjectionRecord:
        assert fault.trigger is not None  # noqa: S101 - made above
        assert fault.trigger.site is not None  # noqa: S101
        told = found.described()
        if found.instruction is not None:
            where = self._places.at(found.instruction.address)
            told |= {"module": where.module, "build_id": where.build_id}
            told |= {"offset": where.offset, "symbol": where.symbol}
        return InjectionRecord(
            status=found.status,
            mode=fault.trigger.site.rung,
            trigger=fault.trigger,
            node=self._kernel,
            kernel=self._kernel,
            invocation=0,
            model=fault.model,
            scope=fault.scope,
            threads_stopped=1,
        ).model_copy(update=told)

    # -- the good call -----------------------------------------------------------------------------

    def _rehearse(self) -> float:
        """The thread time of a good call in a copy, s.

        :raises RuntimeError: if a copy that nobody strikes does not make the golden output.
        """
        copy = self._copies.copy(self._root)
        self._subject.forget()
        end, made = self._finish(copy), self._subject.made()
        if end is None or made.what != "golden":
            message = f"{self._kernel}: a copy that was left alone made another output ({end})"
            raise RuntimeError(message)
        return made.spent_ns / 1e9


def _cpu_s(pid: int) -> float:
    """Processor time of a process: its clock by the number that clock_getcpuclockid(3) gives it."""
    return time.clock_gettime(~pid << 3 | 2)


@contextmanager
def striking(kernel: str, subject: Subject, pid: int, go: int) -> Iterator[Strikes]:
    """Strikes on copies of the process that ``subject`` forked; it and they are gone afterwards.

    :raises RuntimeError: if the call is not the same in a copy.
    """
    with Tracees(MARK, forks=True, ours=True) as tracees:
        tracees.seize([pid])
        os.write(go, b"x")

        def there() -> bool | None:
            tracees.service()
            return True if tracees.threads[pid].report is not None else None

        if not wait_until(there, _BEGIN_S):
            message = f"{kernel}: the process to be copied never began its call"
            raise RuntimeError(message)
        strikes = Strikes(kernel, subject, pid, tracees)
        try:
            yield strikes
        finally:
            strikes.close()
