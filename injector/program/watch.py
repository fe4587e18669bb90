"""Whether a run hangs, and whether somebody else has killed it."""

from __future__ import annotations

import time
from contextlib import suppress

from injector.program.launched_program import LaunchedProgram
from injector.tracing import ptrace
from injector.tracing.process import cpu_s, sleeps
from injector.tracing.ptrace import GoneError, StopReport
from injector.tracing.tracee import Tracee

HANG_TIMES = 10
"""A run that uses this many times the processor time of a golden one, and ..."""

HANG_MARGIN_S = 0.5
"""... this much more, hangs; so does one that sleeps for that much longer than a golden one takes."""

ASLEEP_LOOKS = 20
"""Looks in a row at which nobody of the program runs."""

_LOOK_S = 0.05
"""Between two looks at whether a run hangs."""


class RunWatch:
    """Hears what a run's threads report, as long as it does not hang.

    ``killed_by_another``: a process outside has sent it a signal, so its end tells nothing.
    """

    def __init__(self, program: LaunchedProgram, cpu_s: float, wall_s: float) -> None:
        """Watch a run of a program of which a golden one takes these times."""
        self._program = program
        self._limits_s = HANG_TIMES * cpu_s + HANG_MARGIN_S, HANG_TIMES * wall_s + HANG_MARGIN_S
        self._begun_s = 0.0, time.monotonic()
        self._limited, self._asleep = False, 0
        self._look_at_s = time.monotonic() + _LOOK_S
        self.killed_by_another = False

    def begin(self) -> None:
        """Limit the processor time from here on, the fault: counting passes took some, too."""
        self._limited = True
        with suppress(OSError):
            self._begun_s = cpu_s(self._program.pid), time.monotonic()

    def next_report(self) -> tuple[Tracee, StopReport] | None:
        """What a thread reports next; None if the run hangs."""
        while True:
            told = self._program.next_report(max(self._look_at_s - time.monotonic(), 0.0))
            if told is not None:
                self._asleep = 0
                self._note(*told)
            if time.monotonic() >= self._look_at_s:  # also of one that reports again and again
                self._look_at_s = time.monotonic() + _LOOK_S
                if self._hangs():
                    return None
            if told is not None:
                return told

    def _note(self, thread: Tracee, report: StopReport) -> None:
        if report.kind == "signal":
            try:
                sender = ptrace.signal_sender(thread.tid)
            except GoneError:
                return
            if sender is not None and self._program.is_outside(sender):
                self.killed_by_another = True

    def _hangs(self) -> bool:
        try:
            if self._limited and cpu_s(self._program.pid) - self._begun_s[0] > self._limits_s[0]:
                return True
        except OSError:
            return False  # it ends
        late = time.monotonic() - self._begun_s[1] > self._limits_s[1]
        asleep = late and all(sleeps(tid) for tid in self._program.threads)
        self._asleep = self._asleep + 1 if asleep else 0
        return self._asleep >= ASLEEP_LOOKS
