"""A thread that we trace, and what it is owed when it goes on."""

from __future__ import annotations

from dataclasses import dataclass, field

from injector.tracing import ptrace
from injector.tracing.ptrace import StopReport

TRAPS = ("step", "timer", "gate")
"""Reports of our own traps."""


@dataclass(slots=True, eq=False)
class Tracee:
    """A traced thread: why it stands (None: it runs) and which signals it gets when it goes on."""

    pid: int
    tid: int
    report: StopReport | None = None
    signals: list[int] = field(default_factory=list)
    timed: bool = False  # a timer was set on it: a trap may be under way

    @property
    def stepped(self) -> bool:
        """Whether it stands in single steps."""
        return self.report is not None and self.report.kind == "step"

    def next_signal(self) -> int:
        """The signal to deliver on resuming: only a thread that stands at a signal takes one that way.

        Others, which came while stepping, are sent again.
        """
        if not self.signals:
            return 0
        at_signal = self.report is not None and self.report.kind in ("signal", *TRAPS)
        first = self.signals.pop(0) if at_signal else 0
        for number in self.signals:
            ptrace.send(self.pid, self.tid, number)
        self.signals.clear()
        return first
