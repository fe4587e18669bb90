"""Log files: lines with the time they came, rotated, bounded in how fast they grow; and how to read them."""

from __future__ import annotations

import contextlib
import heapq
import os
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from deploy.compose.stack_file import LogLimits

LINE_BYTES = 16_384
"""A longer line is broken: a process that never ends its line must not fill our memory."""

READ_BYTES = 1 << 16


def stamp() -> str:
    """The current time in UTC, as log lines begin with it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class Log:
    """The log of one process over all its starts.

    ``lost`` counts the lines that were not kept: more came than the limits grant, or the disk refused.
    Each gap is also noted in the log itself, at its place.
    """

    def __init__(self, path: Path, limits: LogLimits) -> None:
        self.path = path
        self.limits = limits
        self.lost = 0
        self._untold = 0
        self._rest = b""
        self._grant = float(limits.bytes_per_s)
        self._granted_s = time.monotonic()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("ab", buffering=0)

    def take(self, data: bytes) -> bool:
        """Add what a process wrote; False if it writes more than it may."""
        self._refill()
        *lines, rest = (self._rest + data).split(b"\n")
        while len(rest) > LINE_BYTES:
            lines.append(rest[:LINE_BYTES])
            rest = rest[LINE_BYTES:]
        self._rest = rest
        lost = self.lost
        self._keep([line[i : i + LINE_BYTES] for line in lines for i in range(0, len(line) or 1, LINE_BYTES)])
        return self.lost == lost

    def end_line(self) -> None:
        """End the last line once the writer is gone, and note how much was lost."""
        if self._rest:
            rest, self._rest = self._rest, b""
            self._keep([rest])
        self._tell_gap()

    def tell_gap_if_over(self) -> None:
        """Once the flood is over, note in the log how much of it is missing."""
        self._refill()
        if self._untold and self._grant > self.limits.bytes_per_s / 2:
            self._tell_gap()

    def close(self) -> None:
        """Write what is left and close the file."""
        self.end_line()
        self._file.close()

    def _refill(self) -> None:
        now_s, most = time.monotonic(), float(self.limits.bytes_per_s)
        self._grant = min(most, self._grant + (now_s - self._granted_s) * most)
        self._granted_s = now_s

    def _keep(self, lines: list[bytes]) -> None:
        now = stamp().encode()
        for index, line in enumerate(lines):
            stamped = now + b" " + line + b"\n"
            if len(stamped) > self._grant:
                self._lose(len(lines) - index)
                return
            self._tell_gap()
            self._grant -= len(stamped)
            if not self._write(stamped):
                self._lose(1)

    def _lose(self, lines: int) -> None:
        self.lost += lines
        self._untold += lines

    def _tell_gap(self) -> None:
        if self._untold:
            untold, self._untold = self._untold, 0
            if not self._write(f"{stamp()} zenfi: {untold} lines lost here\n".encode()):
                self._untold = untold

    def _write(self, stamped: bytes) -> bool:
        """Write to the file; False if that failed: on a full disk the supervisor goes on, and counts."""
        try:
            if self._file.tell() + len(stamped) > self.limits.file_bytes:
                self._rotate()
            self._file.write(stamped)
        except OSError:
            return False
        return True

    def _rotate(self) -> None:
        """``NAME.log`` becomes ``NAME.log.1`` and so on; the oldest goes."""
        oldest = self.limits.files - 1
        if oldest:
            for number in range(oldest - 1, 0, -1):
                older = rotated(self.path, number)
                if older.exists():
                    older.replace(rotated(self.path, number + 1))
            self.path.replace(rotated(self.path, 1))
        before, self._file = self._file, self.path.open("wb", buffering=0)
        before.close()


def rotated(path: Path, number: int) -> Path:
    """The file that a log became ``number`` rotations ago."""
    return path.with_name(f"{path.name}.{number}")


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


class LogFollower:
    """Reads what is appended to one log from now on."""

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
        """Close the log file that is followed."""
        if self._file is not None:
            self._file.close()
