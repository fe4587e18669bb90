"""Where an address lies in an ELF file: build id, virtual address, symbol.

Source: System V ABI, chapters 4 and 5 (64-bit little-endian objects).
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from injector.tracing.process import MemoryMap, MemoryMapping

_PT_LOAD, _PT_NOTE = 1, 4
_SHT_PROGBITS, _SHT_SYMTAB, _SHT_DYNSYM = 1, 2, 11
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
    show it. For code in no file (compiled at run time), ``module`` is empty and ``offset`` is the
    address itself, which repeats because address randomisation is off.
    """

    module: str
    build_id: str
    offset: int
    symbol: str


class CodeLocations:
    """Where addresses of a process lie; each is found, and each file is read, but once."""

    def __init__(self, pid: int, maps: MemoryMap) -> None:
        self._pid, self._maps = pid, maps
        self._files: dict[str, _File] = {}
        self._found: dict[int, CodeLocation] = {}

    def at(self, address: int) -> CodeLocation:
        """Where an address lies; what the file does not tell is left empty."""
        if address not in self._found:
            self._found[address] = self._find(address)
        return self._found[address]

    def _find(self, address: int) -> CodeLocation:
        mapping = self._maps.at(address)
        if mapping is None or not mapping.path:
            return CodeLocation("", "", address, "")
        if mapping.path not in self._files:
            self._files[mapping.path] = _File(_content(self._pid, mapping.path))
        file = self._files[mapping.path]
        offset = file.virtual(address - mapping.start + mapping.offset)
        name = Path(mapping.path).name.removesuffix(" (deleted)")
        return CodeLocation(name, file.build_id, offset, file.symbol(offset))


def place(pid: int, maps: MemoryMap, address: int) -> CodeLocation:
    """Where one ``address`` lies; what the file does not tell is left empty."""
    return CodeLocations(pid, maps).at(address)


class _File:
    """An ELF file; of another one nothing is told."""

    def __init__(self, content: mmap.mmap | None) -> None:
        self.build_id = ""
        self._loaded: list[tuple[int, int, int]] = []
        self._functions: list[tuple[int, NDArray[np.void]]] = []
        self._content = content
        if content is None or content[:6] != b"\x7fELF\x02\x01":
            return
        _, _, _, _, _, program, sections, _, _, _, programs, _, count, _ = _HEADER.unpack_from(content)
        for at in range(programs):
            kind, _, start, virtual, _, size, _, _ = _PROGRAM.unpack_from(
                content, program + at * _PROGRAM.size
            )
            if kind == _PT_LOAD:
                self._loaded.append((start, size, virtual))
            if kind == _PT_NOTE:
                self.build_id = self.build_id or _build_id(content[start : start + size])
        for names, table in _tables(content, sections, count):
            kinds = table["info"] & 15
            self._functions.append((names, table[(kinds == _FUNCTIONS[0]) | (kinds == _FUNCTIONS[1])]))

    def virtual(self, in_file: int) -> int:
        """The virtual address of a byte of the file."""
        found = in_file
        for start, size, virtual in self._loaded:
            if start <= in_file < start + size:
                found = in_file - start + virtual
        return found

    def symbol(self, address: int) -> str:
        """The function that covers an address; the full table is asked before that of exported names."""
        for names, table in self._functions:
            inside = np.flatnonzero((table["value"] <= address) & (address - table["value"] < table["size"]))
            if len(inside) and self._content is not None:
                return _name(self._content, names + int(table[inside[0]]["name"]))
        return ""


def locate(pid: int, maps: MemoryMap, module: str, build_id: str, offset: int) -> int | None:
    """The address of what :func:`place` told; None if no such code is loaded."""
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


def functions(pid: int, mapping: MemoryMapping) -> Iterator[tuple[str, int]]:
    """Name and address of every function that the file behind a piece of code defines and tells of.

    Those that are chosen when the file is loaded (STT_GNU_IFUNC) are left out.
    """
    content = _content(pid, mapping.path)
    if content is None or content[:6] != b"\x7fELF\x02\x01":
        return
    _, _, _, _, _, program, sections, _, _, _, programs, _, section_count, _ = _HEADER.unpack_from(content)
    segments = [_PROGRAM.unpack_from(content, program + at * _PROGRAM.size) for at in range(programs)]
    loaded = [
        mapping.start - mapping.offset + start - virtual
        for kind, _, start, virtual, _, size, _, _ in segments
        if kind == _PT_LOAD and start <= mapping.offset < start + size + mmap.PAGESIZE
    ]
    for names, table in _tables(content, sections, section_count) if loaded else ():
        for symbol in table[(table["info"] & 15 == _FUNCTIONS[0]) & (table["section"] != 0)]:
            address = loaded[-1] + int(symbol["value"])
            if mapping.start <= address < mapping.end:
                yield _name(content, names + int(symbol["name"])), address


def code_sections(pid: int, mapping: MemoryMapping) -> list[tuple[int, int]]:
    """Where the code lies in a piece of memory: all of it if no file is behind it, or one without sections.

    A file may have constants between its sections of code.
    """
    content = _content(pid, mapping.path) if mapping.path else None
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


def _content(pid: int, path: str) -> mmap.mmap | None:
    for candidate in (Path(f"/proc/{pid}/root{path}"), Path(path)):
        try:
            with candidate.open("rb") as file:
                return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError):  # gone, or empty
            continue
    return None


def _build_id(notes: bytes) -> str:
    at = 0
    while at + _NOTE.size <= len(notes):
        name_size, size, kind = _NOTE.unpack_from(notes, at)
        name = at + _NOTE.size
        description = name + (name_size + 3) // 4 * 4
        if kind == _NT_GNU_BUILD_ID and notes[name : name + name_size] == b"GNU\0":
            return notes[description : description + size].hex()
        at = description + (size + 3) // 4 * 4
    return ""


def _tables(content: mmap.mmap, sections: int, count: int) -> Iterator[tuple[int, NDArray[np.void]]]:
    """Each table of symbols, after where the names begin that it refers to."""
    headers = [_SECTION.unpack_from(content, sections + at * _SECTION.size) for at in range(count)]
    for wanted in (_SHT_SYMTAB, _SHT_DYNSYM):
        for _, kind, _, _, start, size, link, _, _, _ in headers:
            if kind == wanted:
                table = np.frombuffer(content, _SYMBOL, size // _SYMBOL.itemsize, start)
                yield headers[link][4], table


def _name(content: mmap.mmap, at: int) -> str:
    return content[at : content.find(b"\0", at)].decode(errors="replace")
