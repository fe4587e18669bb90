"""Thousands of runs of one program, each with one fault, and what came of each.

A run is counted once, in translation (:mod:`injector.program.counted_program`). From that, dynamic
instructions are drawn by the law of flights (docs/internals/sampling.md). Each run with a fault is launched
anew and runs its own code at its own speed to the drawn instruction, where it is struck, and to its end.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence

from injector.block_profile.counted_call import UncountableError
from injector.block_profile.instruction_counts import InstructionCounts
from injector.faults.apply import apply_fault
from injector.faults.record import exact_site, record_of
from injector.faults.stopped_thread import InjectionResult
from injector.kernel_study.results import CallLength, SamplePoint, StudyResult, StudyRun
from injector.program.approach import NotReachedError, ProgramApproach
from injector.program.comparison import OutputDifference, UnsuitableProgramError
from injector.program.counted_program import CountedProgram
from injector.program.launched_program import Ending, LaunchedProgram
from injector.program.profile import ProgramProfile
from injector.program.runs import GoldenRun, ProgramRuns
from injector.program.watch import RunWatch
from injector.tracing.elf import CodeLocation, CodeLocations
from injector.tracing.process import VanishedError
from injector.tracing.ptrace import GoneError
from injector.tracing.source_lines import SourceLines
from services.models.faults.specification import FaultSpec, Trigger
from services.runtime import rng
from services.system.signal_names import signal_name

COUNTED_S = 1800.0
"""Longest wall time without a sign of life from a run that is counted."""

ATTEMPTS = 3
"""Runs in a row that somebody else may kill."""


class ProgramInjector:
    """Strikes one program again and again. Only in a process of one thread, on Linux for x86-64."""

    def __init__(self, runs: ProgramRuns, limit_s: float) -> None:
        """Run the program without a fault.

        :raises UnsuitableProgramError: if it cannot be struck as it is.
        """
        self._runs, self._name = runs, runs.spec.name
        self._golden: GoldenRun = runs.golden(limit_s)
        self._places: CodeLocations | None = None
        self._lines = SourceLines()

    def draw(
        self, fault: FaultSpec, seed: int, indices: Sequence[int]
    ) -> tuple[CallLength, list[SamplePoint]]:
        """Count a run, and draw instructions; none if the fault can strike none.

        :raises UnsuitableProgramError: if the program does not run in translation.
        :raises ScopeError: if it executes nothing of the code that is asked for.
        """
        profile = self.counted()
        eligible: InstructionCounts = profile.eligible(fault)
        drawn = (
            profile.draw(eligible, index, rng.generator(seed, f"program {self._name}", index))
            for index in indices
        )
        length = CallLength(
            scope=profile.scope.executed, eligible=eligible.executed, all=profile.counts.executed
        )
        return length, [point for point in drawn if point is not None]

    def counted(self) -> ProgramProfile:
        """Count the instructions of a run without a fault.

        :raises UnsuitableProgramError, ScopeError: as :meth:`draw` does.
        """
        try:
            with self._runs.launch(counted=True) as program:
                counted = CountedProgram(program)
                blocks = counted.run(COUNTED_S)
                ending = program.await_end()
        except UncountableError as error:
            message = f"{self._name}: {error}"
            raise UnsuitableProgramError(message) from error
        difference = self._runs.difference(ending, self._golden)
        if difference.matters:
            message = (
                f"{self._name}: it runs otherwise when its instructions are counted ({difference.words})"
            )
            raise UnsuitableProgramError(message)
        return ProgramProfile(program.pid, counted, blocks, self._runs.spec)

    def run(self, leg: Sequence[SamplePoint], fault: FaultSpec, seed: int) -> Iterator[tuple[int, StudyRun]]:
        """Strike a run at each of some points: number, what came of it.

        :raises UnsuitableProgramError: if somebody else kills the program again and again.
        """
        for point in leg:
            for _ in range(ATTEMPTS):
                done = self._struck(point, fault.model_copy(update={"seed": point.index}), seed)
                if done is not None:
                    yield point.index, done
                    break
            else:
                message = f"{self._name}: a process outside has ended {ATTEMPTS} of its runs"
                raise UnsuitableProgramError(message)

    def _struck(self, point: SamplePoint, fault: FaultSpec, seed: int) -> StudyRun | None:
        """One run with a fault; None if another process has ended it."""
        draw = rng.generator(seed, f"study {self._name}", point.index)
        with self._runs.launch() as program:
            watch = RunWatch(program, self._golden.cpu_s, self._golden.wall_s)
            try:
                thread = ProgramApproach(program, point, watch).run()
                place = self._place_of(program, point.address)
                found = apply_fault(program, thread, program.process, fault, draw)
                found = found or InjectionResult("not_activated", "the place is a system call")
            except NotReachedError as error:
                place, found = None, InjectionResult("not_reached", str(error))
            except (VanishedError, GoneError) as error:
                place, found = None, InjectionResult("failed", str(error))
            watch.begin()
            hangs = bool(found.bits) and not _run_on(program, watch)
            lives = program.main is not None
            program.kill()
        ending = program.await_end()
        if watch.killed_by_another or (ending.status == -signal.SIGKILL and not lives):
            return None
        result, cause, difference = self._judge(fault, found, None if hangs else ending)
        return StudyRun(
            kernel=self._name,
            index=point.index,
            result=result,
            within_tolerance=difference.within_tolerance,
            deviation=difference.deviation,
            cause=cause,
            point=point,
            injection=record_of(
                found,
                fault,
                node=self._name,
                kernel="",
                invocation=0,
                location=None if place is None else lambda _: place,
                precision="exact",
                trigger=None if place is None else Trigger(invocation=0, site=exact_site(place, point.hit)),
            ),
        )

    def _judge(
        self, fault: FaultSpec, found: InjectionResult, ending: Ending | None
    ) -> tuple[StudyResult, str, OutputDifference]:
        """What came of a run: the outcome, its cause, and by how much its output differs."""
        result, cause = self._ended(fault, found, ending)
        if result or ending is None:
            return result or "hang", cause, OutputDifference("")
        difference = self._runs.difference(ending, self._golden)
        return "sdc" if difference.matters else "benign", difference.words, difference

    def _ended(
        self, fault: FaultSpec, found: InjectionResult, ending: Ending | None
    ) -> tuple[StudyResult | None, str]:
        """The outcome, if it does not depend on the run's output."""
        dummy = fault.model == "none" and bool(found.bits)
        if found.status != "injected" and not dummy:
            return "not_injected", found.reason
        if ending is None:
            return "hang", ""
        if ending.status == -signal.SIGXFSZ:
            return "sdc", "it writes on and on"
        if ending.status < 0:
            return "crash", signal_name(-ending.status)
        if ending.status in self._runs.spec.detected:
            return "detected", f"exit status {ending.status}"
        return None, ""

    def _place_of(self, program: LaunchedProgram, address: int) -> CodeLocation:
        """Where an address lies; files that were read for other runs are not read again."""
        if self._places is None or not self._places.named(address)[0]:
            self._places = CodeLocations(program.pid, program.process.maps(), lines=self._lines)
        return self._places.at(address)


def _run_on(program: LaunchedProgram, watch: RunWatch) -> bool:
    """Run to the end from the fault on; False if the program hangs."""
    program.resume_all()
    while program.main is not None:
        told = watch.next_report()
        if told is None:
            return False
        thread, report = told
        if report.kind in ("step", "timer"):  # a trap of its own making
            thread.signals.append(signal.SIGTRAP)
        if report.kind != "gone":
            program.resume(thread)
    return True
