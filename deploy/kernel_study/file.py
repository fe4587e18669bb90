"""The file of a kernel study: JSON lines, written while it is made, so that it can be continued.

Of each kernel one line says what is asked for and how long its call is; one line each injection follows.
A line is written whole or, if we are killed meanwhile, taken away again. A kernel whose study is
complete is put in order, so that the same study is the same bytes.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from deploy.errors import BadSpecError
from injector.kernel_study.results import CallLength, StudyRun
from injector.program.spec import ProgramSpec
from services.models.base import Strict
from services.models.faults.specification import FaultSpec


class StudyHeader(Strict):
    """What is asked of a kernel's or program's study, and how many instructions its call or run has."""

    kernel: str
    fault: FaultSpec
    seed: int
    length: CallLength
    program: ProgramSpec | None = None


class StudyLine(Strict):
    """One line of a kernel study's file: a header or the run of one injection."""

    study: StudyHeader | None = None
    run: StudyRun | None = None


class KernelSection:
    """One kernel's part: what :class:`deploy.kernel_study.study.Study` knows and keeps."""

    def __init__(
        self, kernel: str, fault: FaultSpec, seed: int, file: StudyFile, program: ProgramSpec | None = None
    ) -> None:
        self.kernel, self.fault, self.seed, self.program = kernel, fault, seed, program
        self._file = file
        self.length: CallLength | None = None
        self.runs: dict[int, StudyRun] = {}

    def head(self) -> StudyLine:
        """The header line of the section, which precedes its runs."""
        assert self.length is not None  # noqa: S101 - begun before
        return StudyLine(
            study=StudyHeader(
                kernel=self.kernel,
                fault=self.fault,
                seed=self.seed,
                length=self.length,
                program=self.program,
            )
        )

    def begin(self, length: CallLength) -> None:
        """Keep how long the kernel's call is."""
        self.length = length
        self._file.append(self.head())

    def add(self, run: StudyRun) -> None:
        """Keep the result of one injection."""
        self.runs[run.index] = run
        self._file.append(StudyLine(run=run))

    def finish(self, runs: Sequence[StudyRun]) -> None:
        """Keep exactly these runs as the study's; others were more than asked for."""
        self.runs = {run.index: run for run in runs}
        self._file.tidy()


class StudyFile:
    """All kernels' parts; without a path they are kept in memory only. One study at a time uses a file."""

    def __init__(self, path: Path | None) -> None:
        """Open the file, or create it, and read what it holds.

        :raises BadSpecError: if it is no such file, cannot be written, or is in use.
        """
        self._path = path
        self._sections: dict[str, KernelSection] = {}
        self._descriptor: int | None = None
        if path is not None:
            try:
                self._descriptor = _locked(path)
                self._read(path)
            except OSError as error:
                message = f"--output {path}: {error.strerror}"
                raise BadSpecError(message) from error

    def _read(self, path: Path) -> None:
        content = path.read_bytes()
        whole = content.rfind(b"\n") + 1
        try:
            lines = [StudyLine.model_validate_json(line) for line in content[:whole].splitlines()]
            for line in lines:
                self._take(line)
        except (ValidationError, KeyError) as error:
            message = f"--output {path}: no file of a kernel study"
            raise BadSpecError(message) from error
        if whole < len(content):
            os.truncate(path, whole)

    def _take(self, line: StudyLine) -> None:
        if line.study is not None:
            head = line.study
            section = KernelSection(head.kernel, head.fault, head.seed, self, head.program)
            section.length = head.length
            self._sections[head.kernel] = section
        if line.run is not None:
            self._sections[line.run.kernel].runs[line.run.index] = line.run

    def section(
        self, kernel: str, fault: FaultSpec, seed: int, program: ProgramSpec | None = None
    ) -> KernelSection:
        """The section of a kernel or program, new or from the file.

        :raises BadSpecError: if it is from another fault, seed or command.
        """
        found = self._sections.get(kernel)
        if found is None:
            found = self._sections[kernel] = KernelSection(kernel, fault, seed, self, program)
        elif (found.fault, found.seed, found.program) != (fault, seed, program):
            asked = "another fault, seed or command" if program else "another fault or seed"
            message = f"--output {self._path}: {kernel} was struck with {asked}: choose another file"
            raise BadSpecError(message)
        return found

    def append(self, line: StudyLine) -> None:
        """Append a line to the file, if there is one."""
        if self._descriptor is not None:
            os.write(self._descriptor, _bytes(line))

    def tidy(self) -> None:
        """Rewrite the file in order: kernels as they came, runs by number."""
        if self._path is None:
            return
        lines = [
            line
            for section in self._sections.values()
            if section.length is not None
            for line in [
                section.head(),
                *(StudyLine(run=section.runs[index]) for index in sorted(section.runs)),
            ]
        ]
        new = self._path.with_name(self._path.name + ".new")
        descriptor = os.open(new, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        new.write_bytes(b"".join(map(_bytes, lines)))
        os.fsync(descriptor)
        new.replace(self._path)
        self.close()
        self._descriptor = descriptor

    def close(self) -> None:
        """Close the file and release its lock."""
        if self._descriptor is not None:
            os.close(self._descriptor)


def _bytes(line: StudyLine) -> bytes:
    return line.model_dump_json(by_alias=True, exclude_none=True, exclude_defaults=True).encode() + b"\n"


def _locked(path: Path) -> int:
    """Open the file for appending, with an exclusive lock.

    :raises BadSpecError: if somebody has.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        message = f"--output {path}: another study is writing it"
        raise BadSpecError(message) from error
    return descriptor


def kept_runs(path: Path) -> dict[str, list[StudyRun]]:
    """What a file holds of each kernel, also while a study is made; nothing if there is none.

    :raises BadSpecError: if it is no such file.
    """
    found: dict[str, list[StudyRun]] = {}
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return found
    try:
        for text in content[: content.rfind(b"\n") + 1].splitlines():
            run = StudyLine.model_validate_json(text).run
            if run is not None:
                found.setdefault(run.kernel, []).append(run)
    except ValidationError as error:
        message = f"{path}: no file of a kernel study"
        raise BadSpecError(message) from error
    return found


def kept_study(path: Path) -> tuple[StudyHeader, dict[int, StudyRun]]:
    """What a file of one study holds: what was asked for, and the runs by their numbers.

    :raises BadSpecError: if it is no such file.
    """
    try:
        content = path.read_bytes()
        lines = [
            StudyLine.model_validate_json(one) for one in content[: content.rfind(b"\n") + 1].splitlines()
        ]
        (header,) = [one.study for one in lines if one.study is not None]
    except (OSError, ValueError) as error:
        message = f"{path}: no file of a study of a program"
        raise BadSpecError(message) from error
    return header, {one.run.index: one.run for one in lines if one.run is not None}
