"""Faults in runs of any program, thousands of them: which crash it, hang it or change its output in silence.

>>> study = zenfi.programs.run(["gzip", "-c", "data.bin"], 1000)
>>> study.summary.shares["sdc"], study.by("register")
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError
from rich.console import Console
from rich.progress import Progress

from dashboard.analysis.kernel_study import (
    PROGRAM_RESULTS,
    WAYS,
    KernelSummary,
    OutcomeShare,
    divided,
    summarise,
)
from deploy.config.workdir import mission_folder
from deploy.config.written_faults import fault_fields
from deploy.errors import BadSpecError, one_line
from deploy.kernel_study.file import StudyFile, kept_study
from deploy.kernel_study.program_study import (
    ENVIRONMENT,
    LIMIT_S,
    ProgramStudySpec,
    load_program_study,
    located,
    program_study,
    study_of,
)
from deploy.kernel_study.study import Study
from deploy.kernel_study.workers import program_worker
from injector.kernel_study.results import StudyRun
from injector.program.spec import ProgramOrder, ProgramSpec
from services.models.faults.specification import FaultSpec

__all__ = [
    "ENVIRONMENT",
    "LIMIT_S",
    "ProgramStudy",
    "ProgramStudySpec",
    "ReplayedRun",
    "load",
    "make",
    "program",
    "replay",
    "run",
]


@dataclass(frozen=True)
class ProgramStudy:
    """What faults did to runs of one program: a summary with intervals, and every run."""

    program: ProgramSpec
    fault: FaultSpec
    seed: int
    summary: KernelSummary
    runs: list[StudyRun]

    def by(self, way: str) -> list[tuple[str, int, dict[str, OutcomeShare]]]:
        """Outcomes divided by what was struck, the most frequent first: of each its name, count and shares.

        :raises BadSpecError: if they cannot be divided so.
        """
        if way not in WAYS:
            message = f"by {way!r}: known are {', '.join(WAYS)}"
            raise BadSpecError(message)
        return divided(self.runs, way, PROGRAM_RESULTS)


def program(
    command: Sequence[str],
    *,
    environment: Mapping[str, str] | None = None,
    stdin: str = os.devnull,
    inputs: Sequence[str] = (),
    compare: Sequence[str] = (),
    ignore: Sequence[str] = (),
    status: int = 0,
    detected: Sequence[int] = (),
    tolerance: float | None = None,
    comparator: Sequence[str] = (),
    module: str = "",
    symbol: str = "",
    address: int | None = None,
    line: str = "",
) -> ProgramSpec:
    """Describe a program, found as a shell finds it; it will run in this folder.

    With ``inputs`` (copied into it) or ``compare`` (files that it writes) each run has a folder of its own.
    It finds :data:`ENVIRONMENT` and ``environment``, and nothing of this process's; without a fault it ends
    with exit ``status``. ``tolerance`` and ``comparator`` say which outputs count as the same. ``line`` is
    the source line whose code is struck, as ``FILE:LINE``.

    :raises BadSpecError: if there is no such program or file, or something does not go together.
    """
    if not command:
        raise BadSpecError("no command: it names the program")
    try:
        spec = ProgramSpec(
            command=tuple(command),
            environment=dict(environment or {}),
            stdin=stdin,
            inputs=tuple(inputs),
            compare=tuple(compare),
            ignore=tuple(ignore),
            status=status,
            detected=tuple(detected),
            tolerance=tolerance,
            comparator=tuple(comparator),
            module=module,
            symbol=symbol,
            address=address,
            line=line,
        )
    except ValidationError as error:
        raise BadSpecError(one_line(error)) from error
    return located(spec, Path.cwd())


def load(file: Path | str) -> ProgramStudySpec:
    """Read the study in a TOML file, to be made by :func:`make`; names in it are relative to its folder.

    :raises BadSpecError: naming the file and the key, if something in it is none or does not go together.
    """
    return load_program_study(Path(file))


def run(
    what: ProgramSpec | Sequence[str],
    injections: int = 1000,
    *,
    seed: int = 0,
    slots: int | None = None,
    fault: str = "",
    output: Path | str | None = None,
    limit_s: float = LIMIT_S,
    progress: bool = True,
) -> ProgramStudy:
    """Strike so many runs of a program, so many at a time (default: one per processor).

    ``fault`` is what is flipped, e.g. ``bits=2``. ``output`` keeps the runs in a file and goes on with it.

    :raises BadSpecError: if the program cannot be struck as it is, or the file holds something else.
    """
    spec = what if isinstance(what, ProgramSpec) else program(what)
    study = study_of(spec, fault_fields(fault), runs=injections, seed=seed, limit_s=limit_s)
    return make(study, slots=slots, output=output, progress=progress)


def make(
    spec: ProgramStudySpec,
    *,
    slots: int | None = None,
    output: Path | str | None = None,
    progress: bool = True,
) -> ProgramStudy:
    """Make a study as it is specified, e.g. that of a file; ``slots`` and ``output`` as of :func:`run`.

    :raises BadSpecError: if the program cannot be struck as it is, or the output holds something else.
    """
    path = Path(output) if output is not None else None
    bar = Progress(console=Console(stderr=True), disable=not progress)
    with program_study(spec, path, slots or len(os.sched_getaffinity(0))) as (study, section), bar:
        known = set(section.runs)
        task = bar.add_task(spec.program.name, total=spec.runs, completed=min(len(known), spec.runs))
        begin = time.monotonic()
        runs = study.run(lambda _: bar.advance(task))
        made = sum(one.index not in known for one in runs)
        section.finish(runs)
        rates = made / (time.monotonic() - begin), 1e3 * study.cpu_s / made if made else 0.0
        assert section.length is not None  # noqa: S101 - the study is made
        summary = summarise(
            spec.program.name, "relative", runs, section.length, *rates, results=PROGRAM_RESULTS
        )
    return ProgramStudy(spec.program, spec.fault, spec.seed, summary, runs)


@dataclass(frozen=True)
class ReplayedRun:
    """A run of a file that was made again: what it was then, what it is now."""

    was: StudyRun
    now: StudyRun

    @property
    def same(self) -> bool:
        """Whether outcome, cause, instruction and all values are the same.

        Debug information that was installed or removed since then makes no difference.
        """
        line = {"line": self.was.injection.line}
        now = self.now.model_copy(update={"injection": self.now.injection.model_copy(update=line)})
        return self.was == now


def replay(
    file: Path | str, indices: Sequence[int] = (), *, slots: int | None = None, limit_s: float = LIMIT_S
) -> list[ReplayedRun]:
    """Make runs of a file again, all that were injected or those with these numbers.

    :raises BadSpecError: if it is no such file, or has no such run, or the program is gone.
    """
    header, runs = kept_study(Path(file))
    if header.program is None:
        message = f"{file}: it holds no runs of a program"
        raise BadSpecError(message)
    if missing := [one for one in indices if one not in runs]:
        message = f"{file}: there is no run {missing[0]}"
        raise BadSpecError(message)
    wanted = [runs[index] for index in indices] or [one for one in runs.values() if one.point is not None]
    section = StudyFile(None).section(header.kernel, header.fault, header.seed, header.program)
    with mission_folder() as scratch:
        order = ProgramOrder(program=header.program, limit_s=limit_s, scratch=str(scratch))
        at_a_time = slots or len(os.sched_getaffinity(0))
        again = Study(program_worker(order), header.fault, 0, header.seed, at_a_time, section)
        made = again.make_again([one.point for one in wanted if one.point is not None])
    return [ReplayedRun(one, made[one.index]) for one in wanted]
