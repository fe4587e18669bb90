"""A fault in a process that somebody has stopped: where a thread stands, and the process stays stopped."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from injector.attach.approach import ApproachReport
from injector.attach.untrapped_tracees import UntrappedTracees
from injector.faults.apply import apply_fault
from injector.faults.approach import Approach, MissedError
from injector.faults.corruption import Corruption
from injector.faults.stopped_thread import InjectionResult
from injector.tracing.process import Process
from services.models.faults.specification import FaultSpec


@dataclass
class StoppedApproach(Approach):
    """Injects into one thread of a stopped process, which takes a step or some, and no more.

    The kernel has it stopped again when it is no longer traced.
    """

    DIED = "the process ended before the fault"

    tracees: UntrappedTracees
    process: Process
    tid: int
    fault: FaultSpec
    corruption: Corruption
    draw: np.random.Generator
    report: ApproachReport = field(default_factory=lambda: ApproachReport(precision="exact"))

    def _run(self) -> InjectionResult:
        self.report.tid = self.tid
        self.tracees.stop_all()
        if self.tid not in self.tracees.threads:
            raise MissedError("failed", f"before the fault: thread {self.tid} ended")
        thread = self.tracees.threads[self.tid]
        found = apply_fault(self.tracees, thread, self.process, self.fault, self.draw, self.corruption)
        if found is None:
            waits = f"thread {self.tid} waits in a system call, where nothing is struck"
            raise MissedError("not_activated", f"{waits}: let it run first: kill -CONT {self.process.pid}")
        return found
