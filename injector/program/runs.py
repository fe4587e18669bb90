"""Runs of one program in one slot: where they run, what they write, and whether that is as it should be."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, Self

from injector.program.comparison import (
    ABSENT,
    OutputDifference,
    RunOutput,
    UnsuitableProgramError,
    compared_by,
    deviation_of,
    digest_of,
)
from injector.program.launched_program import Ending, LaunchedProgram, Launcher, Order, padded
from injector.program.spec import STREAMS, ProgramSpec
from services.system.signal_names import signal_name

GOLDEN_RUNS = 3
"""Runs without a fault, whose output must be the same."""

LARGEST_FILE = 64 << 20
"""Bytes that a run may write into a file, or twice what a golden one writes."""

_WRITE = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
_UNPROTECTED = "no mount namespace can be made here: a fault may have it change any file that you can change"
FILES = "files"
"""The folder in which a run with a folder of its own is run, beside its standard output and error."""


@dataclass(frozen=True, slots=True)
class GoldenRun:
    """The output of runs without a fault, and the longest times that one of them took."""

    output: RunOutput
    cpu_s: float
    wall_s: float


class ProgramRuns:
    """Launches a program again and again, within ``with``, which removes what its runs have written."""

    def __init__(self, spec: ProgramSpec, processor: int, scratch: Path) -> None:
        """Make ready; each run has one ``processor``. What runs write lies in ``scratch``.

        Threads on several would run in another order each time.
        """
        self.spec, self._processor = spec, processor
        self._environment = padded(spec.executable, spec.command, spec.environment)
        self._largest, self._scratch = LARGEST_FILE, scratch

    def __enter__(self) -> Self:
        self._folder = Path(tempfile.mkdtemp(dir=self._scratch))
        self._of_run, self._of_golden = self._folder / "run", self._folder / "golden"
        self._of_run.mkdir()
        self._launcher = Launcher(self._processor, self._folder)
        return self

    def __exit__(self, *_: object) -> None:
        self._launcher.__exit__()
        shutil.rmtree(self._folder, ignore_errors=True)

    def launch(self, *, counted: bool = False) -> LaunchedProgram:
        """Launch the program, to be traced within ``with``; one that is counted tells when threads end.

        :raises LaunchError: if it cannot be executed.
        """
        spec = self.spec
        own = self._of_run / FILES
        if spec.has_own_folder:
            shutil.rmtree(own, ignore_errors=True)
            own.mkdir()
        for name in spec.inputs:
            shutil.copy2(Path(spec.folder) / name, own / Path(name).name)
        order = Order(
            executable=spec.executable,
            arguments=spec.command,
            environment=self._environment,
            folder=str(own) if spec.has_own_folder else spec.folder,
            streams=[
                (spec.stdin, os.O_RDONLY),
                *((str(self._of_run / name), _WRITE) for name in STREAMS),
            ],
            largest_file=self._largest,
        )
        return self._launcher.launch(order, exits=counted)

    def output(self, ending: Ending) -> RunOutput:
        """What the last run left behind: how it ended, and the digests of its files."""
        found = tuple((name, digest_of(self._file(name))) for name in self.spec.compared)
        return RunOutput(ending.status, found)

    def difference(self, ending: Ending, golden: GoldenRun) -> OutputDifference:
        """What the last run has otherwise than one without a fault, by the specified comparison.

        :raises UnsuitableProgramError: if the comparator fails.
        """
        output = self.output(ending)
        words = output.differs_from(golden.output)
        if not words or output.status != golden.output.status:
            return OutputDifference(words)
        if self.spec.comparator:
            same = compared_by(self.spec.comparator, self.spec.folder, self._of_golden, self._of_run)
            return OutputDifference("" if same else words)
        if self.spec.tolerance is None:
            return OutputDifference(words)
        apart = [
            deviation_of(file, self._of_golden / file.relative_to(self._of_run))
            for file in map(self._file, self.spec.compared)
        ]
        known = [one for one in apart if one is not None]
        deviation = max(known) if len(known) == len(apart) else None
        within = deviation is not None and deviation <= self.spec.tolerance
        return OutputDifference(words, within_tolerance=within, deviation=deviation)

    def _file(self, name: str) -> Path:
        return self._of_run / name if name in STREAMS else self._of_run / FILES / name

    def golden(self, limit_s: float) -> GoldenRun:
        """Run the program without a fault.

        :raises UnsuitableProgramError: if it does not end in the time, or its output differs from run to run.
        """
        name, outputs = self.spec.name, []
        cpu_s = wall_s = 0.0
        for _ in range(GOLDEN_RUNS):
            begin = time.monotonic()
            with self.launch() as program:
                if not program.run_to_end(limit_s):
                    message = f"{name}: a run without a fault did not end within {limit_s:g} s (--limit-s)"
                    raise UnsuitableProgramError(message)
                ending = program.await_end()
            outputs.append(self.output(ending))
            if len(outputs) == 1:
                shutil.copytree(self._of_run, self._of_golden)
            elif self.difference(ending, GoldenRun(outputs[0], 0.0, 0.0)).matters:
                self._refuse(outputs[-1].differs_from(outputs[0]))
            cpu_s, wall_s = max(cpu_s, ending.cpu_s), max(wall_s, time.monotonic() - begin)
        self._check(outputs[0])
        if not self._launcher.protects:
            sys.stderr.write(f"zenfi: {name}: {_UNPROTECTED}\n")
        sizes = [self._file(one).stat().st_size for one in self.spec.compared if self._file(one).exists()]
        self._largest = max(LARGEST_FILE, 2 * max(sizes, default=0))
        return GoldenRun(outputs[0], cpu_s, wall_s)

    def _first_error(self) -> str:
        lines = self._file("stderr").read_text(errors="replace").splitlines()
        return f" ({lines[0][:200]})" if lines else ""

    def _if_it_writes(self) -> str:
        if self.spec.has_own_folder or not self._launcher.protects:
            return ""
        return "; if it has to write files: --input or --compare FILE gives it a folder in which it can"

    def _refuse(self, differs: str) -> NoReturn:
        message = (
            f"{self.spec.name}: its output is not the same in each run without a fault ({differs}): take "
            "away what changes it, do not compare it (--ignore), or say how (--tolerance, --comparator)"
        )
        raise UnsuitableProgramError(message)

    def _check(self, golden: RunOutput) -> None:
        name = self.spec.name
        if golden.status < 0:
            message = f"{name}: {signal_name(-golden.status)} ends it without a fault"
            raise UnsuitableProgramError(message)
        if golden.status != self.spec.status:
            message = (
                f"{name}: it ends with exit status {golden.status} without a fault{self._first_error()}; "
                f"if that is right: --status {golden.status}{self._if_it_writes()}"
            )
            raise UnsuitableProgramError(message)
        if golden.status in self.spec.detected:
            message = f"--detected {golden.status}: {name} ends so without a fault, too"
            raise UnsuitableProgramError(message)
        absent = [one for one, digest in golden.digests if digest == ABSENT]
        if absent:
            message = f"--compare {absent[0]}: {name} writes no such file"
            raise UnsuitableProgramError(message)
