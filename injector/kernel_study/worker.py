"""A worker of the kernel study, `injector.kernel_study.worker KERNEL`: reads tasks, writes answers, in lines.

What it needs to inject is imported after the process that is copied has been forked: the less that one has,
the faster it is copied. That one must be the same to the byte in all workers, so that they count the same
instructions: see :mod:`injector.reproducible.launch`.
"""

from __future__ import annotations

import importlib
import os
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
    from injector.kernel_study.results import StudyAnswer  # noqa: PLC0415
    from injector.kernel_study.study import subject_injector  # noqa: PLC0415
    from injector.kernel_study.tasks import answer_tasks, say  # noqa: PLC0415
    from injector.tracing.ptrace import GoneError  # noqa: PLC0415

    try:
        with subject_injector(kernel, subject, pid, go) as injector:
            answer_tasks(injector)
    except (UncountableError, CheckpointError, RemoteForkError, GoneError) as error:
        say(StudyAnswer(problem=str(error)))


if __name__ == "__main__":
    main()
