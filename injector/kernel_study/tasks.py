"""Answering the tasks that a worker of a study reads from standard input, whatever it strikes."""

from __future__ import annotations

import resource
import sys
from collections.abc import Iterator, Sequence
from typing import Protocol

from injector.kernel_study.results import CallLength, SamplePoint, StudyAnswer, StudyRun, StudyTask
from services.models.faults.specification import FaultSpec


class SampleInjector(Protocol):
    """Draws instructions of one thing, a kernel's call or a program's run, and injects at them."""

    def draw(
        self, fault: FaultSpec, seed: int, indices: Sequence[int]
    ) -> tuple[CallLength, list[SamplePoint]]:
        """Draw instructions by their numbers; how many there are."""

    def run(self, leg: Sequence[SamplePoint], fault: FaultSpec, seed: int) -> Iterator[tuple[int, StudyRun]]:
        """Inject at each of some points: number, what came of it."""


def answer_tasks(injector: SampleInjector) -> None:
    """Answer tasks until there are no more: a line each, and one at the end of each task."""
    for line in sys.stdin:
        task = StudyTask.model_validate_json(line)
        if task.draw:
            length, drawn = injector.draw(task.fault, task.seed, task.draw)
            say(StudyAnswer(length=length, drawn=tuple(drawn)))
        for _, run in injector.run(task.leg, task.fault, task.seed):
            say(StudyAnswer(run=run))
        say(StudyAnswer(cpu_s=_cpu_s()))


def say(answer: StudyAnswer) -> None:
    """Write one line to standard output, for whom the worker works."""
    sys.stdout.write(answer.model_dump_json(by_alias=True, exclude_none=True) + "\n")
    sys.stdout.flush()


def _cpu_s() -> float:
    """Processor time that we and what we have started, if it has ended, used."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in both)
