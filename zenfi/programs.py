"""Faults in runs of any program, thousands of them: which crash it, hang it or change its output in silence.

>>> study = zenfi.programs.run(["gzip", "-c", "data.bin"], 1000)
>>> study.summary.shares["sdc"], study.by("register")
"""

from __future__ import annotations

import os
import platform
import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

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
from deploy.config.check import check_machine
from deploy.config.workdir import mission_folder
from deploy.config.written_faults import fault_fields
from deploy.errors import BadSpecError
from deploy.kernel_study.file import StudyFile, kept_study
from deploy.kernel_study.study import Study
from deploy.kernel_study.workers import program_worker
from injector.kernel_study.results import StudyRun
from injector.program.spec import STREAMS, ProgramOrder, ProgramSpec
from injector.tracing.source_lines import SourceLineError, parsed_line
from services.models.faults.specification import FaultSpec

LIMIT_S = 600.0
"""Longest wall time of a run without a fault."""

ENVIRONMENT = {
    "LANG": "C.UTF-8",
    "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
    "PERL_HASH_SEED": "0",
    "PYTHONHASHSEED": "0",
}
"""What a program finds, whoever runs it; more is passed by name."""


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
    if platform.machine() != "x86_64":
        raise BadSpecError("programs are struck on x86-64 only")
    found = shutil.which(command[0]) if command else None
    if found is None:
        message = f"{command[0] if command else 'no command'}: no such program, or it cannot be executed"
        raise BadSpecError(message)
    for name in (stdin, *inputs):
        if not Path(name).exists():
            message = f"{name}: no such file"
            raise BadSpecError(message)
    for name in compare:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            message = f"--compare {name}: expected a file in the run's own folder, by a relative name"
            raise BadSpecError(message)
    if unknown := [one for one in ignore if one not in STREAMS]:
        message = f"--ignore {unknown[0]}: known are {', '.join(STREAMS)}"
        raise BadSpecError(message)
    if tolerance is not None and comparator:
        raise BadSpecError("--tolerance and --comparator both say what counts as the same: leave out one")
    if address is not None and not module:
        raise BadSpecError("--address needs its module: MODULE+0x10")
    _check_line(line)
    return ProgramSpec(
        command=tuple(command),
        executable=os.path.abspath(found),  # noqa: PTH100 - a link stays one: programs look at their names
        folder=str(Path.cwd()),
        environment=ENVIRONMENT | dict(environment or {}),
        stdin=os.path.abspath(stdin),  # noqa: PTH100
        inputs=tuple(inputs),
        outputs=tuple(compare),
        ignored=tuple(ignore),
        status=status,
        detected=tuple(detected),
        tolerance=tolerance,
        comparator=tuple(comparator),
        module=module,
        symbol=symbol,
        address=address,
        line=line,
    )


def _check_line(line: str) -> None:
    try:
        if line:
            parsed_line(line)
    except SourceLineError as error:
        raise BadSpecError(str(error)) from error


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
    asked = FaultSpec.model_validate({"target": spec.name, **fault_fields(fault)})
    check_machine(asked)
    if asked.recurs or asked.level != "instruction":
        raise BadSpecError("--fault: a program's run is struck once, at level instruction")
    aimed = asked.model_copy(update={"scope": "thread"})  # of a kernel's name, too
    path = Path(output) if output is not None else None
    bar = Progress(console=Console(stderr=True), disable=not progress)
    with mission_folder() as scratch, closing(StudyFile(path)) as file, bar:
        section = file.section(spec.name, aimed, seed, spec)
        known = set(section.runs)
        task = bar.add_task(spec.name, total=injections, completed=min(len(known), injections))
        begin = time.monotonic()
        workers = program_worker(ProgramOrder(program=spec, limit_s=limit_s, scratch=str(scratch)))
        study = Study(workers, aimed, injections, seed, slots or len(os.sched_getaffinity(0)), section)
        runs = study.run(lambda _: bar.advance(task))
        made = sum(one.index not in known for one in runs)
        section.finish(runs)
        rates = made / (time.monotonic() - begin), 1e3 * study.cpu_s / made if made else 0.0
        assert section.length is not None  # noqa: S101 - the study is made
        summary = summarise(spec.name, "relative", runs, section.length, *rates, results=PROGRAM_RESULTS)
    return ProgramStudy(spec, aimed, seed, summary, runs)


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
