"""The kernel study on this machine: workers, one a processor, each with its share of the injections."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence

from deploy.check import BadSpecError
from deploy.supervisor import InfrastructureError
from injector.architecture import AbsentError, require
from injector.preflight import check as preflight
from injector.study import StudyRun
from services.bus.mission import FaultSpec
from services.kernels import KERNELS


def check_study(kernels: Sequence[str]) -> None:
    """Refuse what cannot be studied.

    :raises BadSpecError: naming the kernel or what this machine lacks, and what would be right.
    """
    for kernel in kernels:
        if kernel not in KERNELS:
            message = f"unknown kernel {kernel!r}; known: {', '.join(KERNELS)}"
            raise BadSpecError(message)
    for finding in preflight():
        if not finding.ok:
            message = f"cannot inject: {finding.name}: {finding.remedy}"
            raise BadSpecError(message)


def study(kernel: str, fault: FaultSpec, injections: int, seed: int, slots: int) -> Iterator[StudyRun]:
    """Strike ``kernel`` alone, ``injections`` times. Leaving early ends everything that was started.

    Which injection a slot makes changes nothing but the order in which they come.

    :raises BadSpecError: if this processor has no such registers.
    :raises InfrastructureError: if a worker ended before its share was done.
    """
    try:
        require(fault)
    except AbsentError as error:
        raise BadSpecError(str(error)) from error
    cpus = sorted(os.sched_getaffinity(0))
    workers = [
        subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [
                *(sys.executable, "-m", "injector.study", kernel, fault.model_dump_json()),
                *map(str, (seed, injections, slot, slots, cpus[slot % len(cpus)])),
            ],
            env={**os.environ, "PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        for slot in range(min(slots, injections))
    ]
    made: Counter[int] = Counter()
    try:
        working = list(enumerate(workers))
        while working:
            # In turn: they are about as fast as each other, and a pipe holds what is not yet read.
            for slot, worker in list(working):
                assert worker.stdout is not None  # noqa: S101 - asked for above
                line = worker.stdout.readline()
                if line:
                    made[slot] += 1
                    yield StudyRun.model_validate_json(line)
                else:
                    working.remove((slot, worker))
    finally:
        for worker in workers:
            worker.kill()
            worker.communicate()
    if made.total() != injections:
        message = f"{kernel}: a worker ended after {made.total()} of {injections} injections"
        raise InfrastructureError(message)
