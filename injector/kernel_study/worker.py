"""A worker of the kernel study, `injector.kernel_study.worker KERNEL`: reads tasks, writes answers, in lines.

What it needs to inject is imported after the process that is copied has been forked: the less that one has,
the faster it is copied. That one must be the same to the byte in all workers, so that they count the same
instructions: see :mod:`injector.reproducible.launch`.
"""

from __future__ import annotations

import importlib
import os
import resource
import sys

from numba.core import event

from injector.kernel_study.subject import Subject
from injector.reproducible.launch import begin_again_if, begin_again_to_compile
from services.kernels import find_kernel
from services.system import plug_ins
from services.system.lifeline import die_with_parent


def main() -> None:
    """Answer tasks until there are no more."""
    die_with_parent()
    name, *reference = sys.argv[1:]
    plug_ins.tell({f"planners/{name}": where for where in reference})
    kernel = find_kernel(name)
    assert kernel is not None  # noqa: S101 - it was checked before
    with event.install_recorder("numba:compile") as compiled:
        importlib.import_module(kernel.samples_module)
        begin_again_to_compile()
        subject = Subject(kernel)
    begin_again_if(bool(compiled.buffer))
    _answer(name, subject, *subject.fork())
    # Without the interpreter's own clean-up: nanobind would complain of OMPL's leaks at length.
    os._exit(os.EX_OK)


def _answer(kernel: str, subject: Subject, pid: int, go: int) -> None:
    from injector.block_profile.counted_call import UncountableError  # noqa: PLC0415
    from injector.kernel_study.checkpoints import CheckpointError  # noqa: PLC0415
    from injector.kernel_study.remote_fork import RemoteForkError  # noqa: PLC0415
    from injector.kernel_study.results import StudyAnswer, StudyTask  # noqa: PLC0415
    from injector.kernel_study.study import subject_injector  # noqa: PLC0415
    from injector.tracing.ptrace import GoneError  # noqa: PLC0415

    def say(answer: StudyAnswer) -> None:
        sys.stdout.write(answer.model_dump_json(by_alias=True, exclude_none=True) + "\n")
        sys.stdout.flush()

    try:
        with subject_injector(kernel, subject, pid, go) as injector:
            for line in sys.stdin:
                task = StudyTask.model_validate_json(line)
                if task.draw:
                    length, drawn = injector.draw(task.fault, task.seed, task.draw)
                    say(StudyAnswer(length=length, drawn=tuple(drawn)))
                for _, run in injector.run(task.leg, task.fault, task.seed):
                    say(StudyAnswer(run=run))
                say(StudyAnswer(cpu_s=_cpu_s()))
    except (UncountableError, CheckpointError, RemoteForkError, GoneError) as error:
        say(StudyAnswer(problem=str(error)))


def _cpu_s() -> float:
    """Processor time that we and the copies that have ended used."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in both)


if __name__ == "__main__":
    main()
