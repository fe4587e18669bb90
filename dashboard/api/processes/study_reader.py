"""What a study of a program has found so far: its file is read as it grows, each line once."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from dashboard.analysis.kernel_study import PROGRAM_RESULTS, OutcomeShare, StudySummary, StudyTally
from deploy.kernel_study.file import StudyHeader, StudyLine
from injector.kernel_study.results import StudyResult, StudyRun

MOST_STUDIES = 16
"""Studies of which the counts are kept; of others the file is read again."""


class StudyReader:
    """The runs in a study's file; in memory are counts, and where in the file each run is."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._begin()

    def _begin(self) -> None:
        self._inode, self._read_bytes = -1, 0
        self._header: StudyHeader | None = None
        self._tally = StudyTally(PROGRAM_RESULTS)
        self._places: dict[int, tuple[int, int, StudyResult]] = {}

    def summary(self) -> StudySummary | None:
        """The outcomes so far; None while the program's instructions are not counted yet."""
        with self._current():
            if self._header is None:
                return None
            return self._tally.summary(self._header.kernel, "relative", self._header.length)

    def causes(self) -> dict[str, int]:
        """Of the runs that have a cause: outcome and cause, the most frequent first."""
        with self._current():
            named = (pair for pair in self._tally.causes.items() if pair[0][1])
            return {f"{result}: {cause}": count for (result, cause), count in sorted(named, key=_rank)}

    def divided(self, way: str) -> list[tuple[str, int, dict[str, OutcomeShare]]]:
        """The outcomes divided by one of the ways: name, number and shares of each group."""
        with self._current():
            return self._tally.divided(way)

    def run(self, index: int) -> StudyRun | None:
        """The run of that number, None if it is not made."""
        with self._current() as content:
            return self._at(content, [index])[0] if content and index in self._places else None

    def page(self, after: int, limit: int, result: StudyResult | None) -> tuple[list[StudyRun], int | None]:
        """So many runs with higher numbers than ``after``, and after which the next page begins, if any."""
        with self._current() as content:
            if content is None:
                return [], None
            fits = sorted(
                index
                for index, (_, _, found) in self._places.items()
                if index > after and result in (None, found)
            )
            chosen = fits[:limit]
            return self._at(content, chosen), chosen[-1] if len(fits) > limit else None

    def _at(self, content: BinaryIO, indices: list[int]) -> list[StudyRun]:
        found: list[StudyRun] = []
        for index in indices:
            begin, length, _ = self._places[index]
            content.seek(begin)
            line = StudyLine.model_validate_json(content.read(length))
            assert line.run is not None  # noqa: S101 - it was one when it was noted
            found.append(line.run)
        return found

    @contextmanager
    def _current(self) -> Iterator[BinaryIO | None]:
        """The file, with all in it counted; None if there is none yet. Nobody else reads meanwhile."""
        with self._lock:
            try:
                content = self._path.open("rb")
            except FileNotFoundError:
                self._begin()
                yield None
                return
            with content:
                self._catch_up(content)
                yield content

    def _catch_up(self, content: BinaryIO) -> None:
        """Read what was appended; all of it, if the file was put in order meanwhile."""
        found = os.fstat(content.fileno())
        if found.st_ino != self._inode or found.st_size < self._read_bytes:
            self._begin()
            self._inode = found.st_ino
        content.seek(self._read_bytes)
        for text in content:
            if not text.endswith(b"\n"):
                break  # it is just being written
            self._take(StudyLine.model_validate_json(text), len(text))

    def _take(self, line: StudyLine, length: int) -> None:
        if line.study is not None:
            self._header = line.study
        if line.run is not None and line.run.index not in self._places:
            self._places[line.run.index] = self._read_bytes, length, line.run.result
            self._tally.add(line.run)
        self._read_bytes += length


def _rank(pair: tuple[tuple[str, str], int]) -> tuple[int, tuple[str, str]]:
    return -pair[1], pair[0]


class StudyReaders:
    """Keeps the readers of the files that were asked for last."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: OrderedDict[Path, StudyReader] = OrderedDict()

    def of(self, path: Path) -> StudyReader:
        """The reader of that file, which need not be there yet."""
        with self._lock:
            reader = self._kept.setdefault(path, StudyReader(path))
            self._kept.move_to_end(path)
            if len(self._kept) > MOST_STUDIES:
                self._kept.popitem(last=False)
            return reader
