"""The studies of programs that the service keeps: a folder each, with what was asked for and its runs.

The runs are in the file that ``zenfi program run --output`` writes. Whoever makes a study holds a lock, so
nobody has to note that it is being made, and nothing is left behind by who was killed.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Literal

from deploy.errors import BadSpecError
from deploy.kernel_study.program_study import ProgramStudySpec, load_program_study
from services.models.base import Strict

FOLDER = "program_studies"
"""In the folder of the store."""

STUDY, RUNS, LOG, LOCK = "study.json", "runs.jsonl", "study.log", "making.lock"
NAME = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,59}"
"""What a file of a program may be called, without its suffix: it becomes a part of a label and of a path."""

_LABEL = re.compile(rf"{NAME}-[0-9]{{1,9}}")

KeptPhase = Literal["queued", "paused", "cancelled", "done", "failed"]
StudyPhase = Literal["queued", "running", "paused", "cancelled", "done", "failed"]


class StudyEntry(Strict):
    """What was asked of a study, and where it stands; ``queued`` is also one that is being made.

    ``program`` is the name of the allowed program's file. ``request``: the key of the request that made it.
    """

    label: str
    program: str
    spec: ProgramStudySpec
    slots: int | None
    created: str
    phase: KeptPhase = "queued"
    reason: str = ""
    request: str = ""

    @property
    def number(self) -> int:
        """The number at the end of the label: later ones are larger."""
        return int(self.label.rpartition("-")[2])


def allowed_programs(folder: Path) -> dict[str, ProgramStudySpec]:
    """The studies in the TOML files of a folder, by the names of the files.

    :raises BadSpecError: naming the folder or the file, if it is none.
    """
    if not folder.is_dir():
        message = f"--programs {folder}: no such folder"
        raise BadSpecError(message)
    files = sorted(folder.glob("*.toml"))
    for file in files:
        if not re.fullmatch(NAME, file.stem):
            message = f"--programs {file}: call it by letters, digits, _, - and ., at most 60"
            raise BadSpecError(message)
    return {file.stem: load_program_study(file) for file in files}


class ProgramStudies:
    """The studies in a folder; ``allowed`` are the programs that may be struck, by name.

    Several threads and processes may use a folder at the same time.
    """

    def __init__(self, folder: Path, allowed: Mapping[str, ProgramStudySpec]) -> None:
        self.folder, self.allowed = folder, allowed

    def entries(self) -> list[StudyEntry]:
        """Every study, the newest first."""
        names = [one.name for one in self.folder.iterdir()] if self.folder.is_dir() else []
        found = (self.find(name) for name in names)
        return sorted((one for one in found if one is not None), key=lambda one: -one.number)

    def find(self, label: str) -> StudyEntry | None:
        """The study of that label, None if there is none."""
        if not _LABEL.fullmatch(label):
            return None
        try:
            return StudyEntry.model_validate_json((self.folder / label / STUDY).read_bytes())
        except FileNotFoundError:
            return None

    def create(self, program: str, spec: ProgramStudySpec, slots: int | None, request: str) -> StudyEntry:
        """Keep a new study, to be made in its turn; the one that ``request`` has made already, if it has.

        :raises BadSpecError: if that one is another.
        """
        with self._changing():
            before = next((one for one in self.entries() if request and one.request == request), None)
            if before is not None:
                if (before.program, before.spec, before.slots) != (program, spec, slots):
                    message = f"request {request!r} has created {before.label}, which is another study"
                    raise BadSpecError(message)
                return before
            entry = StudyEntry(
                label=f"{program}-{self._next_number()}",
                program=program,
                spec=spec,
                slots=slots,
                created=datetime.now(UTC).isoformat(timespec="seconds"),
                request=request,
            )
            (self.folder / entry.label).mkdir()
            self._write(entry)
            return entry

    def move(self, label: str, phase: KeptPhase, *, of: tuple[KeptPhase, ...], reason: str = "") -> bool:
        """Change the phase of a study, if it is one ``of`` these; whether it was."""
        with self._changing():
            entry = self.find(label)
            if entry is None or entry.phase not in of:
                return False
            self._write(entry.model_copy(update={"phase": phase, "reason": reason}))
            return True

    def delete(self, label: str) -> bool:
        """Remove a study with its runs, unless it is to be made, or still being made; whether it is gone."""
        with self._changing():
            entry = self.find(label)
            if entry is not None and (entry.phase == "queued" or self.is_made(label)):
                return False
            if entry is not None:
                shutil.rmtree(self.folder / label)
            return True

    def phase(self, entry: StudyEntry) -> StudyPhase:
        """Where a study stands; ``running`` if somebody makes it now."""
        return "running" if entry.phase == "queued" and self.is_made(entry.label) else entry.phase

    def is_made(self, label: str) -> bool:
        """Whether a process makes the study now."""
        try:
            descriptor = os.open(self.folder / label / LOCK, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(descriptor)
        return False

    def runs(self, label: str) -> Path:
        """The file of the runs of a study, which need not be there yet."""
        return self.folder / label / RUNS

    def count(self, label: str) -> int:
        """How many runs a study has made."""
        try:
            found = self.runs(label).stat()
        except FileNotFoundError:
            return 0
        return _lines(self.runs(label), found.st_ino, found.st_size)

    def is_allowed(self, entry: StudyEntry) -> bool:
        """Whether the program of a study is still one that may be struck, and still the same."""
        allowed = self.allowed.get(entry.program)
        return allowed is not None and allowed.program == entry.spec.program

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Nobody else changes anything meanwhile, in whichever thread or process."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / "changes.lock").open("ab") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def _next_number(self) -> int:
        """One that no study has had: that of a deleted one is not given again."""
        file = self.folder / "last_number"
        with suppress(FileNotFoundError):
            number = int(file.read_text()) + 1
            _replace(file, str(number))
            return number
        _replace(file, "1")
        return 1

    def _write(self, entry: StudyEntry) -> None:
        _replace(self.folder / entry.label / STUDY, entry.model_dump_json(by_alias=True, exclude_unset=True))


def _replace(file: Path, text: str) -> None:
    draft = file.with_name(file.name + ".part")
    with draft.open("w") as written:
        written.write(text)
        written.flush()
        os.fsync(written.fileno())
    draft.replace(file)


@contextmanager
def making(folder: Path) -> Iterator[StudyEntry]:
    """The study in a folder, which is known to be made meanwhile; waits for who looks whether it is."""
    with (folder / LOCK).open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield StudyEntry.model_validate_json((folder / STUDY).read_bytes())


@lru_cache(maxsize=512)
def _lines(file: Path, _inode: int, size: int) -> int:
    """Whole lines after the first in so many bytes of a file."""
    with file.open("rb") as content:
        return max(content.read(size).count(b"\n") - 1, 0)
