"""Runs of one program in one slot: where they run, what they write, and whether that is as it should be."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from injector.program.launched_program import Ending, LaunchedProgram, Launcher, Order, padded
from injector.program.spec import STREAMS, ProgramSpec
from services.system.signal_names import signal_name

GOLDEN_RUNS = 3
"""Runs without a fault, whose output must be the same."""

LARGEST_FILE = 64 << 20
"""Bytes that a run may write into a file, or twice what a golden one writes."""

_WRITE = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
_ABSENT = "absent"


class UnsuitableProgramError(Exception):
    """The program cannot be struck as it is: one line that says why and what to do."""


@dataclass(frozen=True, slots=True)
class RunOutput:
    """What a run left: exit status (negative: the signal), and the digest of each file that is compared."""

    status: int
    digests: tuple[tuple[str, str], ...]

    def differs_from(self, golden: RunOutput) -> str:
        """What differs, in words; empty if nothing does."""
        words = [f"exit status {self.status}, not {golden.status}"] if self.status != golden.status else []
        pairs = zip(self.digests, golden.digests, strict=True)
        return ", ".join([*words, *(name for (name, ours), (_, theirs) in pairs if ours != theirs)])


@dataclass(frozen=True, slots=True)
class GoldenRun:
    """The output of runs without a fault, and the longest times that one of them took."""

    output: RunOutput
    cpu_s: float
    wall_s: float


class ProgramRuns:
    """Launches a program again and again, within ``with``, which removes what its runs have written."""

    def __init__(self, spec: ProgramSpec, processor: int) -> None:
        """Make ready; a run that is counted has one ``processor``."""
        self.spec, self._processor = spec, processor
        self._environment = padded(spec.executable, spec.command, spec.environment)
        self._largest = LARGEST_FILE

    def __enter__(self) -> Self:
        self._folder = Path(tempfile.mkdtemp(prefix="zenfi-program-"))
        self._launcher = Launcher()
        return self

    def __exit__(self, *_: object) -> None:
        self._launcher.__exit__()
        shutil.rmtree(self._folder, ignore_errors=True)

    def launch(self, *, counted: bool = False) -> LaunchedProgram:
        """Launch the program, to be traced within ``with``; one that is counted tells when threads end.

        :raises LaunchError: if it cannot be executed.
        """
        spec = self.spec
        own = self._folder / "run"
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
                *((str(self._folder / name), _WRITE) for name in STREAMS),
            ],
            processors=[self._processor] if counted else [],
            largest_file=self._largest,
        )
        return self._launcher.launch(order, exits=counted)

    def output(self, ending: Ending) -> RunOutput:
        """What the last run left behind: how it ended, and the digests of its files."""
        found = tuple((name, _digest(self._file(name))) for name in self.spec.compared)
        return RunOutput(ending.status, found)

    def _file(self, name: str) -> Path:
        return self._folder / name if name in STREAMS else self._folder / "run" / name

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
            cpu_s, wall_s = max(cpu_s, ending.cpu_s), max(wall_s, time.monotonic() - begin)
        self._check(outputs)
        sizes = [self._file(one).stat().st_size for one in self.spec.compared if self._file(one).exists()]
        self._largest = max(LARGEST_FILE, 2 * max(sizes, default=0))
        return GoldenRun(outputs[0], cpu_s, wall_s)

    def _first_error(self) -> str:
        lines = self._file("stderr").read_text(errors="replace").splitlines()
        return f" ({lines[0][:200]})" if lines else ""

    def _check(self, outputs: Sequence[RunOutput]) -> None:
        name, golden = self.spec.name, outputs[0]
        if differs := next(filter(None, (other.differs_from(golden) for other in outputs[1:])), ""):
            message = (
                f"{name}: its output is not the same in each run without a fault ({differs}): take away what "
                "changes it, or do not compare it (--ignore)"
            )
            raise UnsuitableProgramError(message)
        if golden.status < 0:
            message = f"{name}: {signal_name(-golden.status)} ends it without a fault"
            raise UnsuitableProgramError(message)
        if golden.status != self.spec.status:
            message = (
                f"{name}: it ends with exit status {golden.status} without a fault{self._first_error()}; "
                f"if that is right: --status {golden.status}"
            )
            raise UnsuitableProgramError(message)
        if golden.status in self.spec.detected:
            message = f"--detected {golden.status}: {name} ends so without a fault, too"
            raise UnsuitableProgramError(message)
        absent = [one for one, digest in golden.digests if digest == _ABSENT]
        if absent:
            message = f"--output {absent[0]}: {name} writes no such file"
            raise UnsuitableProgramError(message)


def _digest(file: Path) -> str:
    try:
        with file.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    except OSError:
        return _ABSENT
