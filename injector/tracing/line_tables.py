"""The line tables in the debug information (DWARF) of a file: the source line of an address, and back.

Source: DWARF Debugging Information Format, version 5, section 6.2. pyelftools reads all but the opcodes of
the tables, for which it takes twelve times as long.
"""

from __future__ import annotations

import mmap
import posixpath
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import IO, cast

import numpy as np
from elftools.dwarf.compileunit import CompileUnit
from elftools.dwarf.descriptions import describe_form_class
from elftools.dwarf.dwarfinfo import DebugSectionDescriptor
from elftools.dwarf.lineprogram import LineProgram
from elftools.dwarf.ranges import BaseAddressEntry
from elftools.elf.constants import SH_FLAGS
from elftools.elf.elffile import ELFFile
from numpy.typing import NDArray

from injector.tracing.source_lines import DebugInfoError

_COPY, _ADVANCE_PC, _ADVANCE_LINE, _SET_FILE, _CONST_ADD_PC, _FIXED_ADVANCE_PC = 1, 2, 3, 4, 8, 9
_END_SEQUENCE, _SET_ADDRESS = 1, 2

Row = tuple[int, int, int]
"""From this address on, code of the file with this number, and of this line; line 0 is none."""


class LineTable:
    """The code of one compile unit: from each of ``begins`` to ``ends`` it is of one file and one line."""

    def __init__(self, paths: list[str], sequences: list[list[Row]]) -> None:
        """Take over the ``paths`` of files by number, as they are spelled, and rows in ascending order."""
        self.paths = paths
        whole = [np.array(rows, dtype=np.uint64) for rows in sequences] or [np.zeros((0, 3), np.uint64)]
        begins = np.concatenate([rows[:-1] for rows in whole])
        ends = np.concatenate([rows[1:, 0] for rows in whole])
        # Of several rows for one address the last one holds.
        kept = (ends > begins[:, 0]) & (begins[:, 2] > 0) & (begins[:, 1] < len(paths))
        order = np.argsort(begins[kept, 0], kind="stable")
        self.begins, self.files, self.lines = begins[kept][order].T
        self.ends = ends[kept][order]

    def at(self, address: int) -> str:
        """``FILE:LINE`` of an address, with the whole path; empty if it is of no line."""
        index = int(np.searchsorted(self.begins, np.uint64(address), side="right")) - 1
        if index < 0 or address >= int(self.ends[index]):
            return ""
        return f"{posixpath.normpath(self.paths[int(self.files[index])])}:{self.lines[index]}"


class DebugInfo:
    """What the debug information of one file tells of lines; of its compile units only those asked for."""

    def __init__(self, content: mmap.mmap) -> None:
        """Read the sections, which are decompressed.

        :raises DebugInfoError: if that fails.
        """
        with _reading():
            file = ELFFile(cast("IO[bytes]", content))
            self._code = [
                (one["sh_addr"], one["sh_addr"] + one["sh_size"])
                for one in file.iter_sections()
                if one["sh_flags"] & SH_FLAGS.SHF_EXECINSTR
            ]
            self._dwarf = file.get_dwarf_info(relocate_dwarf_sections=False, follow_links=False)
        self._tables: dict[int, LineTable | None] = {}

    def line_at(self, address: int) -> str:
        """``FILE:LINE`` of an address of the file; empty if it is of no line.

        :raises DebugInfoError: if it cannot be read.
        """
        with _reading():
            for ranges in (self._told, self._untold):
                index = int(np.searchsorted(ranges[:, 0], np.uint64(address), side="right")) - 1
                if index >= 0 and address < int(ranges[index, 1]):
                    unit = self._dwarf.get_CU_at(int(ranges[index, 2]))
                    table = self._table(unit)
                    return table.at(address) if table is not None else ""
        return ""

    def tables_of(self, name: str) -> Iterator[LineTable]:
        """The tables of all compile units that may have code of a file of that ``name``, without a folder.

        :raises DebugInfoError: if they cannot be read.
        """
        with _reading():
            if not self._mentions(name):
                return
            seen = set()
            for unit in self._dwarf.iter_CUs():
                program = self._dwarf.line_program_for_CU(unit)
                if program is None or program.program_start_offset in seen:
                    continue
                seen.add(program.program_start_offset)
                if any(posixpath.basename(path) == name for path in _paths(unit, program)):
                    table = self._table(unit)
                    assert table is not None  # noqa: S101 - it has a program
                    yield table

    def _mentions(self, name: str) -> bool:
        """Whether the name of a file is in it at all: looking into each compile unit takes seconds."""
        wanted = f"{name}\0".encode()
        tables, strings = (
            _content(one) for one in (self._dwarf.debug_line_sec, self._dwarf.debug_line_str_sec)
        )
        if wanted in tables:
            return True
        # A linker keeps a name in the end of another one; it counts if somebody refers to it there.
        return any(
            strings[at - 1 : at] in (b"", b"\0", b"/") or at.to_bytes(4, "little") in tables
            for at in (found.start() for found in re.finditer(re.escape(wanted), strings))
        )

    @cached_property
    def _told(self) -> NDArray[np.uint64]:
        """Code of compile units, in order, as a table of the file tells: begin, end, offset of the unit."""
        table = self._dwarf.get_aranges()
        entries = table.entries if table is not None else ()
        return _in_order([(one.begin_addr, one.begin_addr + one.length, one.info_offset) for one in entries])

    @cached_property
    def _untold(self) -> NDArray[np.uint64]:
        """The same of the units that are not in that table; Clang writes none."""
        told = set(self._told[:, 2].tolist())
        others = [one for one in self._dwarf.iter_CUs() if one.cu_offset not in told]
        return _in_order([(*extent, one.cu_offset) for one in others for extent in self._extents(one)])

    def _extents(self, unit: CompileUnit) -> Iterator[tuple[int, int]]:
        given = unit.get_top_DIE().attributes
        low = given["DW_AT_low_pc"].value if "DW_AT_low_pc" in given else 0
        if "DW_AT_ranges" in given:
            lists = self._dwarf.range_lists()
            assert lists is not None  # noqa: S101 - the attribute refers to it
            base = low
            for entry in lists.get_range_list_at_offset(given["DW_AT_ranges"].value, unit):
                if isinstance(entry, BaseAddressEntry):
                    base = entry.base_address
                else:
                    start = 0 if entry.is_absolute else base
                    yield start + entry.begin_offset, start + entry.end_offset
        elif "DW_AT_high_pc" in given:
            high = given["DW_AT_high_pc"]
            yield low, high.value if describe_form_class(high.form) == "address" else low + high.value

    def _table(self, unit: CompileUnit) -> LineTable | None:
        if unit.cu_offset not in self._tables:
            program = self._dwarf.line_program_for_CU(unit)
            self._tables[unit.cu_offset] = self._read(unit, program) if program is not None else None
        return self._tables[unit.cu_offset]

    def _read(self, unit: CompileUnit, program: LineProgram) -> LineTable:
        # Of functions that the linker has left out, rows stay, mostly from address 0 on.
        linked = [
            rows
            for rows in _sequences(program)
            if any(begin <= rows[0][0] < end for begin, end in self._code)
        ]
        return LineTable(_paths(unit, program), linked)


def _content(section: DebugSectionDescriptor | None) -> bytes:
    if section is None:
        return b""
    section.stream.seek(0)
    return section.stream.read()


@contextmanager
def _reading() -> Iterator[None]:
    try:
        yield
    except Exception as error:  # the file may be damaged in any way
        message = f"debug information cannot be read: {type(error).__name__}: {error}".splitlines()[0]
        raise DebugInfoError(message) from error


def _in_order(ranges: list[tuple[int, int, int]]) -> NDArray[np.uint64]:
    mapped = [one for one in ranges if one[0] < one[1] < 2**64]
    return np.array(sorted(mapped), dtype=np.uint64).reshape(-1, 3)


def _paths(unit: CompileUnit, program: LineProgram) -> list[str]:
    """The files of a line program by number, as they are spelled, in the folder of the compilation."""
    folders = [_text(one) for one in program["include_directory"]]
    files = [(_text(one.name), one.dir_index) for one in program["file_entry"]]
    if program["version"] < 5:  # the folder of the compilation stands elsewhere, numbers are from 1 on
        top = unit.get_top_DIE().attributes
        folders.insert(0, _text(top["DW_AT_comp_dir"].value) if "DW_AT_comp_dir" in top else "")
        files.insert(0, ("", 0))
    base = folders[0]
    return [posixpath.join(base, folders[index] if index else "", name) for name, index in files]


def _text(name: object) -> str:
    return name.decode(errors="replace") if isinstance(name, bytes) else ""


def _sequences(program: LineProgram) -> Iterator[list[Row]]:  # noqa: C901, PLR0912 - one case an opcode
    """Run a line program: the rows of each sequence of addresses; the last one tells where it ends."""
    program.stream.seek(program.program_start_offset)
    code = program.stream.read(program.program_end_offset - program.program_start_offset)
    least, first = program["minimum_instruction_length"], program["opcode_base"]
    lowest, lines = program["line_base"], program["line_range"]
    at, rows = 0, list[Row]()
    address, file, line = 0, 1, 1
    while at < len(code):
        opcode, at = code[at], at + 1
        if opcode >= first:
            advance, change = divmod(opcode - first, lines)
            address, line = address + least * advance, line + lowest + change
            rows.append((address, file, line))
        elif opcode == 0:
            length, at = _unsigned(code, at)
            if code[at] == _END_SEQUENCE:
                yield [*rows, (address, file, 0)]
                rows = []
                address, file, line = 0, 1, 1
            elif code[at] == _SET_ADDRESS:
                address = int.from_bytes(code[at + 1 : at + length], "little")
            at += length
        elif opcode == _COPY:
            rows.append((address, file, line))
        elif opcode == _ADVANCE_PC:
            advance, at = _unsigned(code, at)
            address += least * advance
        elif opcode == _ADVANCE_LINE:
            change, after = _unsigned(code, at)
            line += change - (code[after - 1] >> 6 << 7 * (after - at))
            at = after
        elif opcode == _SET_FILE:
            file, at = _unsigned(code, at)
        elif opcode == _CONST_ADD_PC:
            address += least * ((255 - first) // lines)
        elif opcode == _FIXED_ADVANCE_PC:
            address, at = address + int.from_bytes(code[at : at + 2], "little"), at + 2
        else:
            for _ in range(program["standard_opcode_lengths"][opcode - 1]):
                _, at = _unsigned(code, at)


def _unsigned(code: bytes, at: int) -> tuple[int, int]:
    """A number of variable length (LEB128), and where it ends."""
    value = shift = 0
    while code[at] & 0x80:
        value |= (code[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
    return value | code[at] << shift, at + 1
