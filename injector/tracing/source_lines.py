"""Source lines of the code of a process, by debug information in its files or in separate ones."""

from __future__ import annotations

import itertools
import mmap
import posixpath
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

import numpy as np

from injector.tracing.elf import CodeLocations, build_id_in, file_content, named_sections
from injector.tracing.process import MemoryMap
from injector.tracing.symbols import module_code, some_of

if TYPE_CHECKING:
    from injector.tracing.line_tables import DebugInfo, LineTable

SEPARATE = "/usr/lib/debug"
"""Where distributions install the debug information of their programs."""


class SourceLineError(Exception):
    """No code of a source line, or no such file, or not just one: one line that says what there is."""


class DebugInfoError(Exception):
    """Debug information that is damaged or of an unknown kind: one line."""


class SourceLines:
    """The debug information of the files that code comes from; each is looked for, and read, but once."""

    def __init__(self) -> None:
        self._files: dict[str, DebugInfo | None] = {}

    def at(self, pid: int, path: str, offset: int) -> str:
        """``FILE:LINE`` of a virtual address of a file of a process; empty where nothing tells it."""
        try:
            debug = self.of_file(pid, path)
            return debug.line_at(offset) if debug is not None else ""
        except DebugInfoError:
            self._files[path] = None
            return ""

    def of_file(self, pid: int, path: str) -> DebugInfo | None:
        """The debug information of a file of a process.

        :raises DebugInfoError: if it cannot be read.
        """
        if path not in self._files:
            content = _with_debug_info(pid, path)
            self._files[path] = _read(content) if content is not None else None
        return self._files[path]


def parsed_line(asked: str) -> tuple[str, int]:
    """File and number of ``FILE:LINE``.

    :raises SourceLineError: if it is written otherwise.
    """
    file, _, line = asked.rpartition(":")
    if not file or not (line.isascii() and line.isdecimal() and int(line)):
        message = f"line {asked!r}: expected FILE:LINE, such as src/main.c:12"
        raise SourceLineError(message)
    return posixpath.normpath(file), int(line)


def code_of_line(pid: int, maps: MemoryMap, asked: str, module: str = "") -> list[tuple[int, int]]:
    """Where the code of ``FILE:LINE`` lies in a process: first addresses and those behind the last.

    The file's name is the one that was given to the compiler, or the end of its path from a folder on.
    ``module`` narrows the code to one loaded file.

    :raises SourceLineError: if there is none, or if several files are called so.
    :raises SymbolError: if there is no such module.
    """
    name, line = parsed_line(asked)
    pieces = module_code(maps, module) if module else [one for one in maps.code() if one.path]
    lines, places = SourceLines(), CodeLocations(pid, maps)
    without: list[str] = []
    code: list[tuple[str, int, int, int]] = []
    for piece in pieces:
        try:
            debug = lines.of_file(pid, piece.path)
            found = (
                [] if debug is None else list(_code_of_file(debug.tables_of(posixpath.basename(name)), name))
            )
        except DebugInfoError as error:
            message = f"line {asked!r}: {Path(piece.path).name}: {error}"
            raise SourceLineError(message) from error
        if debug is None:
            without.append(Path(piece.path).name)
        shift = piece.start - places.named(piece.start)[2]
        code += [(path, number, begin + shift, end + shift) for path, number, begin, end in found]
    paths = sorted({path for path, _, _, _ in code})
    if not paths:
        raise SourceLineError(_unknown(asked, [Path(one.path).name for one in pieces], without))
    if len(paths) > 1:
        message = f"line {asked!r}: {len(paths)} files end so: give more of the path: {some_of(paths)}"
        raise SourceLineError(message)
    known = sorted({number for _, number, _, _ in code})
    if line not in known:
        near = [*[one for one in known if one < line][-2:], *[one for one in known if one > line][:2]]
        has = ", ".join(map(str, near))
        message = f"line {asked!r} has no code; the nearest lines of {paths[0]} that have: {has}"
        raise SourceLineError(message)
    return [(begin, end) for _, number, begin, end in code if number == line]


def _code_of_file(tables: Iterator[LineTable], name: str) -> Iterator[tuple[str, int, int, int]]:
    """Path, line, begin and end of all code of the files that are called so."""
    for table in tables:
        for number, path in enumerate(table.paths):
            whole = posixpath.normpath(path)
            if not any(one == name or one.endswith(f"/{name}") for one in (path, whole)):
                continue
            rows = np.flatnonzero(table.files == number)
            columns = (table.lines[rows].tolist(), table.begins[rows].tolist(), table.ends[rows].tolist())
            yield from ((whole, *row) for row in zip(*columns, strict=True))


def _unknown(asked: str, files: Sequence[str], without: Sequence[str]) -> str:
    remedy = "compile with -g, or install the separate debug file"
    if len(without) == len(files):
        return f"line {asked!r}: no debug information in {some_of(files)}: {remedy}"
    missing = f"; no debug information in {some_of(without)} ({remedy})" if without else ""
    return f"line {asked!r}: no code of such a file in what has debug information{missing}"


def _with_debug_info(pid: int, path: str) -> mmap.mmap | None:
    """The file that has the line tables of a file's code: itself, or a separate one."""
    content = file_content(pid, path)
    if content is None:
        return None
    candidates = itertools.chain([content], _separate(pid, path, content))
    return next((one for one in candidates if ".debug_line" in named_sections(one)), None)


def _separate(pid: int, path: str, content: mmap.mmap) -> Iterator[mmap.mmap]:
    """Files of debug information that belong to a file: those that gdb takes, in its order."""
    sections = named_sections(content)
    build_id = _build_id(content)
    if build_id:
        one = file_content(pid, f"{SEPARATE}/.build-id/{build_id[:2]}/{build_id[2:]}.debug")
        if one is not None and _build_id(one) == build_id:
            yield one
    link = content[sections.get(".gnu_debuglink", slice(0))]
    name = PurePath(link.split(b"\0")[0].decode(errors="replace")).name
    checksum, folder = int.from_bytes(link[-4:], "little"), PurePath(path).parent
    for where in (folder, folder / ".debug", PurePath(f"{SEPARATE}{folder}")) if name else ():
        one = file_content(pid, str(where / name))
        if one is not None and zlib.crc32(one) == checksum:
            yield one


def _build_id(content: mmap.mmap) -> str:
    return build_id_in(content[named_sections(content).get(".note.gnu.build-id", slice(0))])


def _read(content: mmap.mmap) -> DebugInfo:
    from injector.tracing.line_tables import DebugInfo  # noqa: PLC0415 - most programs need no pyelftools

    return DebugInfo(content)
