"""Reads logs, also while they are written and rotated."""

from __future__ import annotations

import contextlib
import heapq
import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from deploy.compose.logs import rotated


def tail(logs: Mapping[str, Path], lines: int) -> list[tuple[str, str]]:
    """The last ``lines`` lines of each log with the log's name, all in the order in which they came."""
    return list(heapq.merge(*(_last(name, path, lines) for name, path in logs.items()), key=_when))


def _when(line: tuple[str, str]) -> str:
    return line[1].partition(" ")[0]


def _last(name: str, path: Path, lines: int) -> Iterable[tuple[str, str]]:
    found: deque[tuple[str, str]] = deque(maxlen=lines)
    for one in (rotated(path, 1), path):
        with contextlib.suppress(FileNotFoundError), one.open(errors="replace") as file:
            found.extend((name, line.rstrip("\n")) for line in file)
    return found


class Following:
    """What is appended to one log from now on."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = self._opened()
        self._rest = b""
        if self._file is not None:
            self._file.seek(0, os.SEEK_END)

    def _opened(self) -> BinaryIO | None:
        try:
            return self._path.open("rb")
        except FileNotFoundError:
            return None

    def lines(self) -> Iterator[str]:
        """Whole lines that came since the last call.

        More than a whole rotation between two calls is missed; the log itself has it.
        """
        if self._file is None:
            self._file = self._opened()
        while self._file is not None:
            *lines, self._rest = (self._rest + self._file.read()).split(b"\n")
            yield from (line.decode(errors="replace") for line in lines)
            if self._is_current():
                return
            self._file.close()
            self._file = self._opened()

    def _is_current(self) -> bool:
        """Whether the log is still this file, or has moved on to a new one."""
        assert self._file is not None  # noqa: S101 - asked only while it is open
        try:
            return os.fstat(self._file.fileno()).st_ino == self._path.stat().st_ino
        except FileNotFoundError:
            return True

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
