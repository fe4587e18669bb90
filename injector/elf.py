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

from injector.process import Mapping, Maps

_PT_LOAD, _PT_NOTE = 1, 4
_SHT_SYMTAB, _SHT_DYNSYM = 2, 11
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
class Place:
    """A place in code that means the same in every run.

    ``offset`` is the virtual address that the ELF file gives the place, as objdump and addr2line
    show it. For code in no file (compiled at run time), ``module`` is empty and ``offset`` is the
    address itself, which repeats because address randomisation is off.
    """

    module: str
    build_id: str
    offset: int
    symbol: str


def place(pid: int, maps: Maps, address: int) -> Place:
    """Where ``address`` lies; what the file does not tell is left empty."""
    mapping = maps.at(address)
    if mapping is None or not mapping.path:
        return Place("", "", address, "")
    name = Path(mapping.path).name.removesuffix(" (deleted)")
    in_file = address - mapping.start + mapping.offset
    content = _content(pid, mapping.path)
    if content is None or content[:6] != b"\x7fELF\x02\x01":
        return Place(name, "", in_file, "")
    _, _, _, _, _, program, sections, _, _, _, programs, _, section_count, _ = _HEADER.unpack_from(content)
    segments = [_PROGRAM.unpack_from(content, program + at * _PROGRAM.size) for at in range(programs)]
    offset = in_file
    build_id = ""
    for kind, _, start, virtual, _, size, _, _ in segments:
        if kind == _PT_LOAD and start <= in_file < start + size:
            offset = in_file - start + virtual
        if kind == _PT_NOTE:
            build_id = build_id or _build_id(content[start : start + size])
    return Place(name, build_id, offset, _symbol(content, sections, section_count, offset))


def locate(pid: int, maps: Maps, module: str, build_id: str, offset: int) -> int | None:
    """The address of what :func:`place` told; None if no such code is loaded."""
    if not module:
        return offset if maps.at(offset) is not None else None
    for mapping in maps.code():
        if Path(mapping.path).name.removesuffix(" (deleted)") != module:
            continue
        for address in (mapping.start, mapping.end - 1):
            found = place(pid, maps, address)
            nominal = address + offset - found.offset
            if found.build_id == build_id and mapping.start <= nominal < mapping.end:
                return nominal
    return None


def functions(pid: int, mapping: Mapping) -> Iterator[tuple[str, int]]:
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


def _symbol(content: mmap.mmap, sections: int, count: int, address: int) -> str:
    """The function that covers an address; the full table is asked before that of exported names."""
    for names, table in _tables(content, sections, count):
        inside = table[(table["value"] <= address) & (address - table["value"] < table["size"])]
        found = inside[np.isin(inside["info"] & 15, _FUNCTIONS)]
        if len(found):
            return _name(content, names + int(found[0]["name"]))
    return ""


def _tables(
    content: mmap.mmap, sections: int, count: int
) -> Iterator[tuple[int, np.ndarray[tuple[int], np.dtype[np.void]]]]:
    """Each table of symbols, after where the names begin that it refers to."""
    headers = [_SECTION.unpack_from(content, sections + at * _SECTION.size) for at in range(count)]
    for wanted in (_SHT_SYMTAB, _SHT_DYNSYM):
        for _, kind, _, _, start, size, link, _, _, _ in headers:
            if kind == wanted:
                table = np.frombuffer(content, _SYMBOL, size // _SYMBOL.itemsize, start)
                yield headers[link][4], table


def _name(content: mmap.mmap, at: int) -> str:
    return content[at : content.find(b"\0", at)].decode(errors="replace")
