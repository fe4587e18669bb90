"""A worker of the kernel study, `injector.study_worker KERNEL`: tasks in, answers out, in lines.

What it needs to strike is imported after the process that is copied has been forked: the less that one has,
the faster it is copied. That one must be the same to the byte in all workers, so that they count the same
instructions: see :mod:`injector.pristine`.
"""

from __future__ import annotations

import os
import resource
import sys

from numba.core import event

from injector.pristine import begin_again_if
from injector.subject import Subject
from services.bus.lifeline import die_with_parent
from services.kernels import KERNELS


def main() -> None:
    """Answer tasks until there are no more."""
    die_with_parent()
    (kernel,) = sys.argv[1:]
    with event.install_recorder("numba:compile") as compiled:
        subject = Subject(KERNELS[kernel])
    begin_again_if(bool(compiled.buffer))
    _answer(kernel, subject, *subject.fork())
    # Without the interpreter's own clean-up: nanobind would complain of OMPL's leaks at length.
    os._exit(os.EX_OK)


def _answer(kernel: str, subject: Subject, pid: int, go: int) -> None:
    from injector.census import CensusError  # noqa: PLC0415
    from injector.clock import ClockError  # noqa: PLC0415
    from injector.copies import CopyError  # noqa: PLC0415
    from injector.study import Answer, Task, striking  # noqa: PLC0415

    def say(answer: Answer) -> None:
        sys.stdout.write(answer.model_dump_json(by_alias=True, exclude_none=True) + "\n")
        sys.stdout.flush()

    try:
        with striking(kernel, subject, pid, go) as strikes:
            for line in sys.stdin:
                task = Task.model_validate_json(line)
                if task.survey is not None:
                    say(Answer(found=strikes.surveyor.answer(task.survey, f"clock {kernel}")))
                elif task.clock is not None and task.fault is not None:
                    for index, run in strikes.run(task.clock, task.leg, task.fault, task.seed):
                        say(Answer(run=run) if run is not None else Answer(refused=index))
                say(Answer(cpu_s=_cpu_s()))
    except (CensusError, ClockError, CopyError) as error:
        say(Answer(problem=str(error)))


def _cpu_s() -> float:
    """Processor time that we and the copies that have ended used."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in both)


if __name__ == "__main__":
    main()
