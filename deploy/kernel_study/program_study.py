"""A study of a program as a file says it: the program, the fault, how many runs; and how it is made.

::

    runs = 2000
    fault = { bits = 2 }

    [program]
    command = ["gzip", "-n", "data.bin"]
    inputs = ["data.bin"]
    compare = ["data.bin.gz"]
"""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from deploy.config.check import check_machine
from deploy.config.definitions import inlined, read_toml
from deploy.config.workdir import mission_folder
from deploy.errors import BadSpecError, one_line
from deploy.kernel_study.file import KernelSection, StudyFile
from deploy.kernel_study.study import Study
from deploy.kernel_study.workers import program_worker
from injector.program.spec import ProgramOrder, ProgramSpec
from injector.tracing.source_lines import SourceLineError, parsed_line
from services.models.base import Strict
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

_GIVEN = ("target", "level", "scope", "trigger", "seed")
"""What nobody chooses of a fault: it strikes an instruction of the whole run, drawn by the study's seed."""


class ProgramStudySpec(Strict):
    """What is asked of a study: so many runs of a program, each struck once. ``limit_s``: as LIMIT_S is."""

    program: ProgramSpec
    fault: FaultSpec
    runs: int = Field(default=1000, ge=1, le=10_000_000)
    seed: int = Field(default=0, ge=0, lt=2**32)
    limit_s: float = Field(default=LIMIT_S, ge=0.1, le=86_400)


def study_of(program: ProgramSpec, fault: Mapping[str, Any], **more: Any) -> ProgramStudySpec:
    """The study of a program that was :func:`located`, with these fields of its fault and the others.

    :raises BadSpecError: naming the field, if something is none or does not go together.
    """
    if given := [name for name in _GIVEN if name in fault]:
        message = f"fault.{given[0]}: the study of a program chooses it: leave it out"
        raise BadSpecError(message)
    try:
        aimed = FaultSpec.model_validate({**fault, "target": program.name})
    except ValidationError as error:
        message = f"fault.{one_line(error)}".replace("fault.specification:", "fault:")
        raise BadSpecError(message) from error
    if aimed.recurs:
        raise BadSpecError("fault: a program's run is struck once, at level instruction")
    # In scope thread also if a kernel has the program's name.
    aimed = aimed.model_copy(update={"scope": "thread"})
    try:
        spec = ProgramStudySpec.model_validate({**more, "program": program, "fault": aimed})
    except ValidationError as error:
        raise BadSpecError(one_line(error)) from error
    check_machine(spec.fault)
    return spec


def changed_study(
    spec: ProgramStudySpec, fault: Mapping[str, Any] | None, **changed: Any
) -> ProgramStudySpec:
    """A study with other values of ``changed``, and with another fault if one is given.

    :raises BadSpecError: as :func:`study_of`.
    """
    kept = spec.fault.model_dump(exclude=set(_GIVEN), exclude_unset=True)
    more = {name: getattr(spec, name) for name in ("runs", "seed", "limit_s")}
    return study_of(spec.program, kept if fault is None else fault, **(more | changed))


def load_program_study(path: Path) -> ProgramStudySpec:
    """The study in a TOML file; names of files in it are relative to the file's folder.

    :raises BadSpecError: naming the file, if it is none, or says what does not go together.
    """
    fields = read_toml(str(path))
    try:
        table = fields.pop("program", None)
        if not isinstance(table, dict):
            raise BadSpecError("program: a table [program] with the command is needed")
        return study_of(_program(table, path.parent), _fault(fields.pop("fault", {}), path.parent), **fields)
    except BadSpecError as error:
        message = f"{path}: {error}"
        raise BadSpecError(message) from error


def _program(table: Mapping[str, Any], folder: Path) -> ProgramSpec:
    try:
        return located(ProgramSpec.model_validate(table), folder)
    except ValidationError as error:
        message = f"program.{one_line(error)}"
        raise BadSpecError(message) from error


def _fault(given: Any, folder: Path) -> Mapping[str, Any]:
    if not isinstance(given, dict):
        raise BadSpecError("fault: expected a table, e.g. { bits = 2 }")
    if isinstance(given.get("histogram"), str):
        given = {**given, "histogram": str(folder / given["histogram"])}
    content: Mapping[str, Any] = inlined({"fault": given})["fault"]
    return content


def located(spec: ProgramSpec, beside: Path) -> ProgramSpec:
    """A program as it is found by somebody in the folder ``beside``, with all that its runs need.

    :raises BadSpecError: if there is no such program or file, or something does not go together.
    """
    if platform.machine() != "x86_64":
        raise BadSpecError("programs are struck on x86-64 only")
    folder = _absolute(beside, spec.folder)
    word = spec.executable or spec.command[0]
    found = shutil.which(_absolute(Path(folder), word) if "/" in word else word)
    if found is None:
        message = f"{word}: no such program, or it cannot be executed"
        raise BadSpecError(message)
    for name in (spec.stdin, *spec.inputs):
        if not (Path(folder) / name).exists():
            message = f"{name}: no such file"
            raise BadSpecError(message)
    for name in spec.compare:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            message = f"compare: {name}: expected a file in the run's own folder, by a relative name"
            raise BadSpecError(message)
    if spec.tolerance is not None and spec.comparator:
        raise BadSpecError("tolerance and comparator both say what counts as the same: leave out one")
    if spec.address is not None and not spec.module:
        raise BadSpecError("address: needs its module (--address MODULE+0x10)")
    _check_line(spec.line)
    paths = {
        "executable": _absolute(Path.cwd(), found),
        "folder": folder,
        "stdin": _absolute(Path(folder), spec.stdin),
    }
    return spec.model_copy(update={**paths, "environment": ENVIRONMENT | spec.environment})


def _check_line(line: str) -> None:
    try:
        if line:
            parsed_line(line)
    except SourceLineError as error:
        raise BadSpecError(str(error)) from error


def _absolute(folder: Path, name: str) -> str:
    return os.path.abspath(folder / name)  # noqa: PTH100 - a link stays one: programs look at their names


@contextmanager
def program_study(
    spec: ProgramStudySpec, path: Path | None, slots: int
) -> Iterator[tuple[Study, KernelSection]]:
    """The study, to be run, and what is kept of it: in a file that it goes on with, or in memory only.

    :raises BadSpecError: if the file holds something else, or another study is writing it.
    """
    program = spec.program
    with mission_folder() as scratch, closing(StudyFile(path)) as file:
        section = file.section(program.name, spec.fault, spec.seed, program)
        order = ProgramOrder(program=program, limit_s=spec.limit_s, scratch=str(scratch))
        yield Study(program_worker(order), spec.fault, spec.runs, spec.seed, slots, section), section
