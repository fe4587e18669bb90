"""The kernel study on this machine: workers, one a processor, that take the places to strike in lots."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from deploy.config.check import BadSpecError
from deploy.kernel_study.workers import StudyWorkers
from injector.kernel_study.anchor_search import TraceReply, TraceRequest, search_anchors
from injector.kernel_study.checkpoints import SamplePoint, draw, legs
from injector.kernel_study.instruction_index import InstructionIndex
from injector.kernel_study.study import StudyRun, StudyTask
from services.models.fault_spec import FaultSpec
from services.runtime import rng

SEARCHED = 10_000
"""Places that are drawn without a single eligible one before the study is given up."""

MARGIN = 1.02
"""So many times the places that will do are drawn: going through a call again for a few more is dear."""


class StudyProgress(Protocol):
    """The part of a study that was made before, and where more of it is kept."""

    clock: InstructionIndex | None
    runs: dict[int, StudyRun]

    def survey(self, clock: InstructionIndex) -> None:
        """Keep the clock of the kernel's instructions."""

    def add(self, run: StudyRun) -> None:
        """Keep the result of one injection."""


class Study:
    """``injections`` strikes at one kernel alone; what is drawn depends on ``seed`` and nothing else.

    The places are numbered as they are drawn, and some are refused
    (:mod:`injector.kernel_study.instruction_index`); the study is that of the first ones that are not.
    ``cpu_s`` is the processor time that was used.
    """

    def __init__(
        self, kernel: str, fault: FaultSpec, injections: int, seed: int, slots: int, memory: StudyProgress
    ) -> None:
        self._kernel, self._fault, self._injections = kernel, fault, injections
        self._seed, self._slots, self._memory = seed, slots, memory
        self._drawn = 0
        self.cpu_s = 0.0

    def run(self, made: Callable[[StudyRun], object] = lambda _: None) -> list[StudyRun]:
        """Make what is missing, reporting each result; all runs of the study by their numbers.

        :raises InfrastructureError: if a worker fails.
        :raises BadSpecError: if the fault finds nothing to strike in the kernel.
        """
        with StudyWorkers(self._kernel, self._slots) as workers:
            try:
                if self._memory.clock is None:
                    self._memory.survey(self._survey(workers))
                while (missing := self._injections - self._done()) > 0:
                    self._give_up_in_vain()
                    self._round(workers, self._more(missing), made)
            finally:
                self.cpu_s = workers.cpu_s
        return self._first()

    def _give_up_in_vain(self) -> None:
        if self._drawn >= SEARCHED and not self._done():
            message = (
                f"{self._kernel}: the fault can strike none of {self._drawn} instructions that were drawn; "
                "widen its scope, register_class, operand or field"
            )
            raise BadSpecError(message)

    def _survey(self, workers: StudyWorkers) -> InstructionIndex:
        def ask(parts: Sequence[TraceRequest]) -> Iterator[TraceReply]:
            answers = workers.work([StudyTask(search=part) for part in parts])
            return (one.found for one in answers if one.found is not None)

        return search_anchors(ask, f"clock {self._kernel}")

    def _done(self) -> int:
        return sum(index < self._drawn for index in self._memory.runs)

    def _first(self) -> list[StudyRun]:
        runs = self._memory.runs
        return [runs[index] for index in sorted(runs)][: self._injections]

    def _more(self, missing: int) -> list[SamplePoint]:
        """Draw about as many injection points as are still missing."""
        clock = self._memory.clock
        assert clock is not None  # noqa: S101 - surveyed before
        rate = max(self._done(), 1) / self._drawn if self._drawn else clock.kept
        count = missing if rate >= 1 else int(missing / rate * MARGIN) + 8
        if not self._done():
            count = min(count, SEARCHED)
        begin, self._drawn = self._drawn, self._drawn + count
        stream = f"place {self._kernel}"
        return [
            draw(clock, index, rng.generator(self._seed, stream, index))
            for index in range(begin, self._drawn)
        ]

    def _round(
        self, workers: StudyWorkers, places: list[SamplePoint], made: Callable[[StudyRun], object]
    ) -> None:
        known = self._memory.runs
        left = [place for place in places if place.index not in known]
        # Each part of a leg begins the call anew: no more of them than keep everybody busy.
        ways = legs(left, max(1, -(-len(places) // self._slots)))
        task = {"fault": self._fault, "seed": self._seed, "clock": self._memory.clock}
        for answer in workers.work([StudyTask.model_validate({**task, "leg": tuple(way)}) for way in ways]):
            if answer.run is not None:
                self._memory.add(answer.run)
                made(answer.run)
