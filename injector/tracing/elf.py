"""Where an address lies in an ELF file: build id, virtual address, symbol.

Source: System V ABI, chapters 4 and 5 (64-bit little-endian objects).
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from injector.tracing.process import MemoryMap, MemoryMapping

if TYPE_CHECKING:
    # These import numba and pyelftools, which takes its time.
    from injector.tracing.compiled_functions import CompiledFunction, CompiledFunctions
    from injector.tracing.source_lines import SourceLines

_PT_LOAD, _PT_NOTE, _PF_X = 1, 4, 1
_SHT_PROGBITS, _SHT_SYMTAB, _SHT_DYNSYM = 1, 2, 11
_TABLES = (_SHT_SYMTAB, _SHT_DYNSYM)
_SHF_EXECINSTR = 4
_NT_GNU_BUILD_ID = 3
_FUNCTIONS = (2, 10)  # STT_FUNC, STT_GNU_IFUNC
_HEADER = struct.Struct("<16sHHIQQQIHHHHHH")
_PROGRAM = struct.Struct("<IIQQQQQQ")
_SECTION = struct.Struct("<IIQQQQIIQQ")
_NOTE = struct.Struct("<III")
_SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"), ("size", "<u8")]
)


@dataclass(frozen=True, slots=True)
class CodeLocation:
    """A place in code that means the same in every run.

    ``offset`` is the virtual address that the ELF file gives the place, as objdump and addr2line
    show it. In a function that numba has compiled, ``module`` says so, ``build_id`` is the function's
    identity and ``offset`` counts from its beginning. For other code in no file, ``module`` is empty and
    ``offset`` is the address itself, which repeats because address randomisation is off. ``line`` is
    ``FILE:LINE`` where debug information tells it.
    """

    module: str
    build_id: str
    offset: int
    symbol: str
    line: str = ""


class CodeLocations:
    """Where addresses of a process lie; each is found, and each file is read, but once.

    ``compiled`` are the functions that numba compiled in a process that has parted from this one since.
    Without ``lines`` nothing is told of source lines.
    """

    def __init__(
        self,
        pid: int,
        maps: MemoryMap,
        compiled: CompiledFunctions | None = None,
        lines: SourceLines | None = None,
    ) -> None:
        self._pid, self._maps, self._compiled, self._lines = pid, maps, compiled, lines
        self._files: dict[str, _File] = {}
        self._found: dict[int, CodeLocation] = {}
        self._mapping: MemoryMapping | None = None

    def at(self, address: int) -> CodeLocation:
        """Where an address lies; what the file does not tell is left empty."""
        if address not in self._found:
            module, build_id, offset = self.named(address)
            symbol, line = self._symbol(address, offset), self._line(address, offset)
            self._found[address] = CodeLocation(module, build_id, offset, symbol, line)
        return self._found[address]

    def named(self, address: int) -> tuple[str, str, int]:
        """Module, build id and offset of an address, quickly: an order that is the same in every process."""
        mapping = self._mapping_of(address)
        if mapping is not None and mapping.path:
            file = self._file(mapping.path)
            name = Path(mapping.path).name.removesuffix(" (deleted)")
            return name, file.build_id, file.virtual(address - mapping.start + mapping.offset)
        if function := self._function(address):
            return function.module, function.identity, address - function.start
        return "", "", address

    def _symbol(self, address: int, offset: int) -> str:
        mapping = self._mapping_of(address)
        if mapping is not None and mapping.path:
            return self._file(mapping.path).symbol(offset)
        function = self._function(address)
        return function.symbol if function is not None else ""

    def _line(self, address: int, offset: int) -> str:
        mapping = self._mapping_of(address)
        if self._lines is None or mapping is None or not mapping.path:
            return ""
        return self._lines.at(self._pid, mapping.path, offset)

    def _mapping_of(self, address: int) -> MemoryMapping | None:
        if self._mapping is None or not self._mapping.start <= address < self._mapping.end:
            self._mapping = self._maps.at(address)
        return self._mapping

    def _function(self, address: int) -> CompiledFunction | None:
        return self._compiled.at(address) if self._compiled is not None else None

    def _file(self, path: str) -> _File:
        if path not in self._files:
            self._files[path] = _File(file_content(self._pid, path))
        return self._files[path]


def place(
    pid: int,
    maps: MemoryMap,
    address: int,
    compiled: CompiledFunctions | None = None,
    lines: SourceLines | None = None,
) -> CodeLocation:
    """Where one ``address`` lies; what the file does not tell is left empty."""
    return CodeLocations(pid, maps, compiled, lines).at(address)


class _File:
    """An ELF file; of another one nothing is told."""

    def __init__(self, content: mmap.mmap | None) -> None:
        self.build_id = ""
        self._shifts: list[tuple[int, int, int]] = []
        self._functions: list[tuple[int, NDArray[np.void]]] = []
        self._content = content
        if content is None or content[:6] != b"\x7fELF\x02\x01":
            return
        _, _, _, _, _, _, sections, _, _, _, _, _, count, _ = _HEADER.unpack_from(content)
        self._shifts = _shifts(content)
        for kind, _, start, _, _, size, _, _ in _segments(content):
            if kind == _PT_NOTE:
                self.build_id = self.build_id or build_id_in(content[start : start + size])
        for names, table in _tables(content, sections, count):
            kinds = table["info"] & 15
            self._functions.append((names, table[(kinds == _FUNCTIONS[0]) | (kinds == _FUNCTIONS[1])]))

    def virtual(self, in_file: int) -> int:
        """The virtual address of a byte of the file's code."""
        found = in_file
        for start, end, shift in self._shifts:
            if start <= in_file < end:
                found = in_file + shift
        return found

    def symbol(self, address: int) -> str:
        """The function that covers an address; the full table is asked before that of exported names."""
        for names, table in self._functions:
            inside = np.flatnonzero((table["value"] <= address) & (address - table["value"] < table["size"]))
            if len(inside) and self._content is not None:
                return _name(self._content, names + int(table[inside[0]]["name"]))
        return ""


def locate(
    pid: int,
    maps: MemoryMap,
    module: str,
    build_id: str,
    offset: int,
    compiled: CompiledFunctions | None = None,
) -> int | None:
    """The address of what :func:`place` told; None if no such code is loaded."""
    function = compiled.identified(module, build_id) if compiled is not None else None
    if function is not None:
        return function.start + offset
    if not module:
        return offset if maps.at(offset) is not None else None
    places = CodeLocations(pid, maps)
    for mapping in maps.code():
        if Path(mapping.path).name.removesuffix(" (deleted)") != module:
            continue
        for address in (mapping.start, mapping.end - 1):
            found = places.at(address)
            nominal = address + offset - found.offset
            if found.build_id == build_id and mapping.start <= nominal < mapping.end:
                return nominal
    return None


def functions(pid: int, mapping: MemoryMapping, *, exported: bool = False) -> Iterator[tuple[str, int]]:
    """Name and address of every function that the file behind a piece of code defines and tells of.

    Those that are chosen when the file is loaded (STT_GNU_IFUNC) are left out; with ``exported``, those too
    that the file does not offer to others.
    """
    content = file_content(pid, mapping.path)
    if content is None or content[:6] != b"\x7fELF\x02\x01":
        return
    _, _, _, _, _, _, sections, _, _, _, _, _, section_count, _ = _HEADER.unpack_from(content)
    loaded = [
        mapping.start - mapping.offset - shift
        for start, end, shift in _shifts(content)
        if start <= mapping.offset < end
    ]
    kinds = _TABLES[1:] if exported else _TABLES
    for names, table in _tables(content, sections, section_count, kinds) if loaded else ():
        for symbol in table[(table["info"] & 15 == _FUNCTIONS[0]) & (table["section"] != 0)]:
            address = loaded[-1] + int(symbol["value"])
            if mapping.start <= address < mapping.end:
                yield _name(content, names + int(symbol["name"])), address


def _segments(content: mmap.mmap) -> list[tuple[int, ...]]:
    _, _, _, _, _, program, _, _, _, _, count, _, _, _ = _HEADER.unpack_from(content)
    return [_PROGRAM.unpack_from(content, program + at * _PROGRAM.size) for at in range(count)]


def _shifts(content: mmap.mmap) -> list[tuple[int, int, int]]:
    """Of each segment of code: its first byte in the file, that behind the last, what virtual addresses add.

    The whole page is loaded in which it begins: a page of two segments is loaded twice.
    """
    return [
        (start - start % mmap.PAGESIZE, start + size, virtual - start)
        for kind, flags, start, virtual, _, size, _, _ in _segments(content)
        if kind == _PT_LOAD and flags & _PF_X
    ]


def code_sections(pid: int, mapping: MemoryMapping) -> list[tuple[int, int]]:
    """Where the code lies in a piece of memory: all of it if no file is behind it, or one without sections.

    A file may have constants between its sections of code.
    """
    content = file_content(pid, mapping.path) if mapping.path else None
    if content is None or content[:6] != b"\x7fELF\x02\x01":
        return [(mapping.start, mapping.end)]
    _, _, _, _, _, _, sections, _, _, _, _, _, count, _ = _HEADER.unpack_from(content)
    found = []
    for at in range(count):
        _, kind, flags, _, start, size, _, _, _, _ = _SECTION.unpack_from(
            content, sections + at * _SECTION.size
        )
        begin = mapping.start - mapping.offset + start
        if kind == _SHT_PROGBITS and flags & _SHF_EXECINSTR and mapping.start <= begin < mapping.end:
            found.append((begin, min(begin + size, mapping.end)))
    return found or [(mapping.start, mapping.end)]


def segment_end(pid: int, mapping: MemoryMapping) -> int:
    """The address behind what a file's segment has in a piece of memory; the end of that if it is not told.

    Up to the end of the last page are bytes that belong to no segment there, and nobody uses.
    """
    content = file_content(pid, mapping.path) if mapping.path else None
    if content is None or content[:6] != b"\x7fELF\x02\x01":
        return mapping.end
    ends = [end for begin, end, _ in _shifts(content) if begin == mapping.offset]
    return mapping.start + ends[0] - mapping.offset if ends else mapping.end


def file_content(pid: int, path: str) -> mmap.mmap | None:
    """A file as a process sees it, or as we do; None if it is gone, or empty."""
    for candidate in (Path(f"/proc/{pid}/root{path}"), Path(path)):
        try:
            with candidate.open("rb") as file:
                return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError):  # gone, or empty
            continue
    return None


def named_sections(content: mmap.mmap | None) -> dict[str, slice]:
    """Where each section of an ELF file lies in it, by name; none of another file."""
    if content is None or content[:6] != b"\x7fELF\x02\x01":
        return {}
    _, _, _, _, _, _, sections, _, _, _, _, _, count, names = _HEADER.unpack_from(content)
    headers = [_SECTION.unpack_from(content, sections + at * _SECTION.size) for at in range(count)]
    return {
        _name(content, headers[names][4] + name): slice(start, start + size)
        for name, _, _, _, start, size, _, _, _, _ in headers
    }


def build_id_in(notes: bytes) -> str:
    """The build id among the notes of an ELF file, in hexadecimal; empty if there is none."""
    at = 0
    while at + _NOTE.size <= len(notes):
        name_size, size, kind = _NOTE.unpack_from(notes, at)
        name = at + _NOTE.size
        description = name + (name_size + 3) // 4 * 4
        if kind == _NT_GNU_BUILD_ID and notes[name : name + name_size] == b"GNU\0":
            return notes[description : description + size].hex()
        at = description + (size + 3) // 4 * 4
    return ""


def _tables(
    content: mmap.mmap, sections: int, count: int, kinds: Sequence[int] = _TABLES
) -> Iterator[tuple[int, NDArray[np.void]]]:
    """Each table of symbols, after where the names begin that it refers to."""
    headers = [_SECTION.unpack_from(content, sections + at * _SECTION.size) for at in range(count)]
    for wanted in kinds:
        for _, kind, _, _, start, size, link, _, _, _ in headers:
            if kind == wanted:
                table = np.frombuffer(content, _SYMBOL, size // _SYMBOL.itemsize, start)
                yield headers[link][4], table


def _name(content: mmap.mmap, at: int) -> str:
    return content[at : content.find(b"\0", at)].decode(errors="replace")
