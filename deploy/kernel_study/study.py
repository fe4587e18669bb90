"""The kernel study on this machine: workers, one a processor, that take the places to strike in lots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Protocol

from deploy.errors import BadSpecError
from deploy.kernel_study.workers import StudyWorkers, WorkerCommand
from injector.kernel_study.results import CallLength, SamplePoint, StudyRun, StudyTask
from services.kernels import scope_of
from services.models.faults.specification import FaultSpec

LOTS_A_SLOT = 4
"""Lots of places for each worker: each goes through the call anew, and none waits long for the last one."""


class StudyProgress(Protocol):
    """The part of a study that was made before, and where more of it is kept."""

    length: CallLength | None
    runs: dict[int, StudyRun]

    def begin(self, length: CallLength) -> None:
        """Keep how long the kernel's call is."""

    def add(self, run: StudyRun) -> None:
        """Keep the result of one injection."""


class Study:
    """``injections`` strikes at one kernel or program; what is drawn depends on ``seed`` and nothing else.

    ``cpu_s`` is the processor time that was used.
    """

    def __init__(
        self,
        workers: WorkerCommand,
        fault: FaultSpec,
        injections: int,
        seed: int,
        slots: int,
        memory: StudyProgress,
    ) -> None:
        self._workers, self._fault, self._injections = workers, fault, injections
        self._seed, self._slots, self._memory = seed, slots, memory
        self.cpu_s = 0.0

    def run(self, made: Callable[[StudyRun], object] = lambda _: None) -> list[StudyRun]:
        """Make what is missing, reporting each result; all runs of the study by their numbers.

        :raises InfrastructureError: if a worker fails.
        :raises BadSpecError: if the fault finds nothing to strike in the kernel.
        """
        missing = [index for index in range(self._injections) if index not in self._memory.runs]
        if missing:
            with StudyWorkers(self._workers, self._slots) as workers:
                try:
                    self._make(workers, self._draw(workers, missing), made)
                finally:
                    self.cpu_s = workers.cpu_s
        return [self._memory.runs[index] for index in range(self._injections)]

    def make_again(self, points: Sequence[SamplePoint]) -> dict[int, StudyRun]:
        """Strike at points that were drawn before: what came of each, by its number.

        :raises InfrastructureError: if a worker fails.
        """
        if points:
            with StudyWorkers(self._workers, self._slots) as workers:
                self._make(workers, points, lambda _: None)
        return {point.index: self._memory.runs[point.index] for point in points}

    def _draw(self, workers: StudyWorkers, missing: Sequence[int]) -> list[SamplePoint]:
        task = StudyTask(fault=self._fault, seed=self._seed, draw=tuple(missing))
        (answer,) = [one for one in workers.work([task]) if one.length is not None]
        assert answer.length is not None  # noqa: S101 - looked for above
        if not answer.drawn:
            message = (
                f"{self._workers.name}: the fault can strike none of the {answer.length.scope} instructions "
                f"of the call in scope {scope_of(self._fault)}; widen scope, register_class, operand or field"
            )
            raise BadSpecError(message)
        if self._memory.length is None:
            self._memory.begin(answer.length)
        return list(answer.drawn)

    def _make(
        self, workers: StudyWorkers, points: Sequence[SamplePoint], made: Callable[[StudyRun], object]
    ) -> None:
        lots = min(len(points), LOTS_A_SLOT * self._slots)
        cuts = [len(points) * lot // lots for lot in range(lots + 1)]
        legs = [tuple(points[begin:end]) for begin, end in pairwise(cuts)]
        tasks = [StudyTask(fault=self._fault, seed=self._seed, leg=leg) for leg in legs]
        for answer in workers.work(tasks):
            if answer.run is not None:
                self._memory.add(answer.run)
                made(answer.run)
