"""Stopping all threads of a set of processes, stepping one of them, and letting all go whatever happens."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Literal, Self

from injector.tracing import ptrace
from injector.tracing.process import has_ended, sleeps
from injector.tracing.ptrace import StopReport
from injector.tracing.realtime_pause import RealtimePause
from injector.tracing.seized_threads import SeizedThreads
from injector.tracing.tracee import Tracee
from injector.tracing.waiting import hear_of_children, wait_until

STOP_LIMIT_S = 5.0
"""Wall time within which a thread must stop; only one that hangs in a device driver takes longer."""

STEP_LIMIT_S = 5.0
"""Wall time for one instruction: long enough for a page fault on a loaded machine."""

END_LIMIT_S = 1.0
"""Wall time for a thread that has ended to be gone; the first one of a process is once all others are."""

DEATH_LIMIT_S = 20.0
"""Wall time for a killed thread to be gone, on however loaded a machine: its parent hears of it after us."""

QUIET_LIMIT_S = 0.1
"""Wall time for the threads beside the target thread to be asleep all at once."""

FAULTS = frozenset({signal.SIGSEGV, signal.SIGBUS, signal.SIGILL, signal.SIGFPE, signal.SIGTRAP})


class StopError(Exception):
    """A thread did not stop in time."""


class PausableThreads(SeizedThreads):
    """Seized threads that are stopped and resumed together: a pause, whose length is measured.

    ``threads_stopped`` tells how many threads stood in the last pause.
    """

    def __init__(self, gate_signal: int | None = None, *, forks: bool = False, ours: bool = False) -> None:
        super().__init__(gate_signal, forks=forks, ours=ours)
        self.threads_stopped = 0
        self._pause = RealtimePause()
        self.leave_out: Callable[[int], object] = lambda _pause_ns: None
        """Told how long everybody stood, just before they go on."""
        self._ending: list[Tracee] = []
        self._awaits_death = False

    @property
    def pause_us(self) -> float:
        """Wall time from the first interrupt to the last resume of the last pause."""
        return self._pause.length_us

    def stop_all(self) -> None:
        """Stop every thread of the seized processes.

        :raises StopError: if one does not stop.
        """
        self._seize_missed()  # most are found while the others run yet
        self._stop([thread for thread in self.threads.values() if thread.stepped])
        self._pause.begin()
        self._stop_running()
        while self._seize_missed():
            self._stop_running()
        self.threads_stopped = len(self.threads)

    def quieten(self, thread: Tracee) -> bool:
        """Stop the other threads of a thread's process while each sleeps, so that none holds a lock.

        What the thread does from then on, it does alone. False, and all run on: some never slept together.

        :raises StopError: if one does not stop.
        """
        others = [one for one in self.threads.values() if one.pid == thread.pid and one is not thread]
        asleep = wait_until(lambda: all(sleeps(one.tid) for one in others) or None, QUIET_LIMIT_S)
        if asleep:
            self._stop(others)
        return bool(asleep)

    def _stop_running(self) -> None:
        """Stop who runs, those too that others start while they are being stopped."""
        while running := self._running():
            self._stop(running)

    def _stop(self, threads: Iterable[Tracee]) -> None:
        several = list(threads)
        self._interrupt(several)
        self._await_stops(several)

    def _interrupt(self, threads: Iterable[Tracee]) -> None:
        for thread in threads:
            stepped = thread.stepped
            if thread.report is not None and not stepped:
                continue
            thread.report = None
            with suppress(ptrace.GoneError):  # its end is reported next
                ptrace.interrupt(thread.tid)
                if stepped:
                    # It stands again before its next instruction, but no longer in single steps: should we
                    # be killed, it would go on in them untraced, and die of the first.
                    ptrace.resume(thread.tid)

    def _await_stops(self, threads: Sequence[Tracee]) -> None:
        # Who was asked last stands last, as a rule: once it does, nobody else need be waited for.
        late = self._await_stop(reversed(threads), STOP_LIMIT_S / 100)
        # The first thread of a process reports its end only when all others have ended.
        for thread in [one for one in late if has_ended(one.tid)]:
            self._ending.append(self.threads.pop(thread.tid))
        late = self._await_stop(late, STOP_LIMIT_S)
        if late:
            names = ", ".join(f"{thread.tid} of process {thread.pid}" for thread in late)
            message = f"did not stop within {STOP_LIMIT_S} s: thread {names}"
            raise StopError(message)

    def _await_stop(self, threads: Iterable[Tracee], limit_s: float) -> list[Tracee]:
        """Wait for the threads one after the other, each is looked at; who still runs then."""
        deadline = time.monotonic() + limit_s
        return [one for one in threads if self._runs(one) and self._await(one, deadline) is None]

    def _runs(self, thread: Tracee) -> bool:
        return thread.report is None and self.threads.get(thread.tid) is thread

    def _await(self, thread: Tracee, deadline: float) -> StopReport | None:
        """Take in what a running thread reports, if it does so in time."""
        if not self._pause.under_way:
            return wait_until(lambda: self._look(thread), deadline - time.monotonic())
        while True:
            report = ptrace.await_report_or_signal(thread.tid)  # the pause's heartbeat at the latest
            if report is not None:
                return self._take_in(thread, report)
            if time.monotonic() > deadline:
                return None

    def resume_all(self) -> None:
        """Let all threads run, in the order in which they were seized; they stay traced."""
        self._leave_pause_out()
        for thread in self.threads.values():
            if thread.report is not None:
                self.resume(thread)
        self._pause.end()

    def _leave_pause_out(self) -> None:
        if self._pause.under_way:
            self.leave_out(self._pause.so_far_ns)


class TraceeGroup(PausableThreads):
    """The threads that we trace. To be used by one thread, within ``with``, which always detaches."""

    def __enter__(self) -> Self:
        self._signal_mask = hear_of_children()
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.detach_all()
        finally:
            self._close_folders()
            signal.pthread_sigmask(signal.SIG_SETMASK, self._signal_mask)

    def step(self, thread: Tracee) -> Literal["stepped", "ended", "faulted", "gone", "stuck"]:
        """Let a standing thread execute one instruction while the others stay as they are.

        ``ended``: it stands at the gate's signal. ``faulted``: the instruction raised a signal, which is
        delivered when the thread is resumed. Signals from elsewhere wait until then, too. ``stuck``: it
        did not come back and runs.
        """
        deadline = time.monotonic() + STEP_LIMIT_S
        while True:
            thread.report = None
            with suppress(ptrace.GoneError):  # killed; its end is reported next
                ptrace.step(thread.tid)
            report = self._await(thread, deadline)
            if report is None:
                return "stuck"
            if report.kind == "gone":
                return "gone"
            if report.kind == "step":
                return "stepped"
            if report.kind == "gate":
                return "ended"
            if report.kind == "signal" and report.signal in FAULTS:
                return "faulted"

    def trace(self, thread: Tracee, most: int, until: int = 0) -> list[int]:
        """Let a standing thread execute up to ``most`` instructions, until it reports; where they lie.

        If it comes to stand at ``until``, that is the end, too.

        Waits without end: for a thread that somebody kills if it hangs.
        """
        addresses, report = ptrace.trace(thread.tid, most, until)
        thread.report = StopReport("step")
        if report is not None:
            self._take_in(thread, report)
        return addresses

    def detach_all(self) -> None:
        """Let all threads run untraced, in the order in which they were seized.

        :raises StopError: if one cannot be stopped, which is needed to let go of it. The others are free.
        """
        try:
            self._stop_running()
        finally:
            self._leave_pause_out()
            for thread in list(self.threads.values()):
                self._detach(thread)
            self.threads.clear()
            self._pause.end()
            wait_until(self._reaped, DEATH_LIMIT_S if self._awaits_death else END_LIMIT_S)
            self._awaits_death = False

    def _detach(self, thread: Tracee) -> None:
        try:
            if thread.timed:
                self._swallow_timer_trap(thread)
            ptrace.detach(thread.tid, thread.next_signal())
        except ptrace.GoneError:
            self._ending.append(thread)
            self._awaits_death = True

    def _swallow_timer_trap(self, thread: Tracee) -> None:
        """Take a timer's trap that was under way when the thread stopped: untraced, it would die of it."""
        while ptrace.timer_trap_pending(thread.tid):
            thread.report = None
            ptrace.resume(thread.tid)
            self._await(thread, time.monotonic() + STOP_LIMIT_S)

    def _reaped(self) -> Literal[True] | None:
        """Take in the ends of threads that were killed: their parent hears of it only after us."""
        reports = [(thread, ptrace.poll(thread.tid)) for thread in self._ending]
        self._ending = [thread for thread, report in reports if report is None or report.kind != "gone"]
        return None if self._ending else True
