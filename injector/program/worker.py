"""A worker that strikes runs of a program, `injector.program.worker`: reads tasks, writes answers, in lines.

The first line tells which program and how long a run without a fault may take.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
from pathlib import Path

from injector.kernel_study.results import StudyAnswer, StudyTask
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
            _answer(ProgramInjector(runs, order.limit_s))
    except (UnsuitableProgramError, ScopeError, LaunchError, TriggerError, PtraceError) as error:
        _say(StudyAnswer(refused=str(error)))


def _answer(injector: ProgramInjector) -> None:
    for line in sys.stdin:
        task = StudyTask.model_validate_json(line)
        if task.draw:
            length, drawn = injector.draw(task.fault, task.seed, task.draw)
            _say(StudyAnswer(length=length, drawn=tuple(drawn)))
        for _, run in injector.run(task.leg, task.fault, task.seed):
            _say(StudyAnswer(run=run))
        _say(StudyAnswer(cpu_s=_cpu_s()))


def _say(answer: StudyAnswer) -> None:
    sys.stdout.write(answer.model_dump_json(by_alias=True, exclude_none=True) + "\n")
    sys.stdout.flush()


def _cpu_s() -> float:
    """Processor time that we and the programs that have ended used."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in both)


if __name__ == "__main__":
    main()
