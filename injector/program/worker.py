"""A worker that strikes runs of a program, `injector.program.worker`: reads tasks, writes answers, in lines.

The first line tells which program and how long a run without a fault may take.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

from injector.kernel_study.results import StudyAnswer
from injector.kernel_study.tasks import answer_tasks, say
from injector.program.comparison import UnsuitableProgramError
from injector.program.launched_program import LaunchError
from injector.program.profile import ScopeError
from injector.program.program_injector import ProgramInjector
from injector.program.runs import ProgramRuns
from injector.program.spec import ProgramOrder
from injector.tracing.perf_events import TriggerError
from injector.tracing.ptrace import PtraceError
from services.system.lifeline import die_with_parent


def main() -> None:
    """Answer tasks until there are no more."""
    die_with_parent()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    order = ProgramOrder.model_validate_json(sys.stdin.readline())
    processor = min(os.sched_getaffinity(0))
    try:
        with ProgramRuns(order.program, processor, Path(order.scratch)) as runs:
            answer_tasks(ProgramInjector(runs, order.limit_s))
    except (UnsuitableProgramError, ScopeError, LaunchError, TriggerError, PtraceError) as error:
        say(StudyAnswer(refused=str(error)))


if __name__ == "__main__":
    main()
