"""Seizing the threads of processes, and hearing what they report.

A thread that is seized and runs costs it nothing, so seizing is done ahead of time.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress

from injector.tracing import ptrace
from injector.tracing.process import TaskFolder, has_ended, threads, tracer_of
from injector.tracing.ptrace import StopReport
from injector.tracing.tracee import TRAPS, Tracee


class SeizedThreads:
    """The threads that we trace, by tid: seized while they run, and told of by their reports."""

    def __init__(self, gate_signal: int | None = None, *, forks: bool = False, ours: bool = False) -> None:
        """Trace nobody yet. Who gets ``gate_signal`` stands, and the signal is taken away.

        With ``forks``, whom the tracees fork is traced, too. What is ``ours`` dies with us.
        """
        self._gate_signal = gate_signal
        self._forks = forks
        self._ours = ours
        self.threads: dict[int, Tracee] = {}
        self._folders: dict[int, TaskFolder] = {}

    def seize(self, pids: Iterable[int]) -> None:
        """Trace all threads of the processes, and every thread that they start from now on.

        :raises NotPermittedError: if the kernel forbids it.
        """
        for pid in pids:
            if pid not in self._folders:
                self._folders[pid] = TaskFolder(pid)
            self._seize_threads(pid)

    def _seize_threads(self, pid: int) -> bool:
        """Seize the threads of a process that are not ours yet; whether there were any."""
        before = len(self.threads)
        while fresh := [tid for tid in threads(pid) if self._seize(pid, tid)]:
            self.threads |= {tid: Tracee(pid, tid) for tid in fresh}
        return len(self.threads) > before

    def _seize(self, pid: int, tid: int) -> bool:
        """Whether the thread was seized; not if it is ours already or has ended."""
        if tid in self.threads:
            return False
        try:
            ptrace.seize(tid, forks=self._forks, ours=self._ours)
        except ptrace.GoneError:
            return False
        except ptrace.NotPermittedError as error:
            tracer = tracer_of(tid)
            if has_ended(tid):
                return False
            if tracer != threading.get_native_id():
                by = f": thread {tracer} traces it (a debugger?)" if tracer else ""
                message = f"process {pid}: {error}{by}"
                raise ptrace.NotPermittedError(message) from error
            # Its parent, already ours, started it meanwhile.
            self.service()
            self.threads.setdefault(tid, Tracee(pid, tid))
            return False
        return True

    def _seize_missed(self) -> bool:
        """Seize threads that we do not hold: reading the list of threads while some come and go can miss one.

        Whether there were any. Only processes that have another number of threads than we hold are asked.
        """
        held = Counter(thread.pid for thread in self.threads.values())
        missing = [pid for pid, folder in self._folders.items() if folder.count() != held[pid]]
        return sum(self._seize_threads(pid) for pid in missing) > 0

    # -- hearing of them ---------------------------------------------------------------------------

    def service(self) -> None:
        """Let running threads go on that only have a signal or news to pass on; traps of ours stay."""
        for thread in self._running():
            report = self._look(thread)
            if report is not None and report.kind not in ("gone", *TRAPS):
                self.resume(thread)

    def _running(self) -> list[Tracee]:
        return [thread for thread in self.threads.values() if thread.report is None]

    def _look(self, thread: Tracee) -> StopReport | None:
        """Take in what a running thread reports, if anything: it then stands or is gone."""
        report = ptrace.poll(thread.tid)
        return None if report is None else self._take_in(thread, report)

    def _take_in(self, thread: Tracee, report: StopReport) -> StopReport:
        if report.kind == "gone":
            del self.threads[thread.tid]
            return report
        if report.kind == "signal" and report.signal == self._gate_signal:
            report = StopReport("gate")
        elif report.kind == "signal":
            thread.signals.append(report.signal)
        thread.report = report
        if report.kind in ("new_thread", "new_process"):
            with suppress(ptrace.GoneError):  # killed meanwhile, its child with it
                tid = ptrace.started(thread.tid)
                pid = thread.pid if report.kind == "new_thread" else tid
                self.threads.setdefault(tid, Tracee(pid, tid))
        return report

    def resume(self, thread: Tracee) -> None:
        """Let one standing thread run, with the signal that it is owed; one in a group-stop stays in it."""
        group_stop = thread.report is not None and thread.report.kind == "group_stop"
        number = thread.next_signal()
        thread.report = None
        with suppress(ptrace.GoneError):  # killed while it stood; its end is reported next
            if group_stop:
                ptrace.listen(thread.tid)
            else:
                ptrace.resume(thread.tid, number)

    def _close_folders(self) -> None:
        while self._folders:
            self._folders.popitem()[1].close()
