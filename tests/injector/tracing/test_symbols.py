"""Names of functions: how C++ and Rust write them, and how somebody may ask for them."""

import os
import struct
from pathlib import Path

import pytest

from injector.tracing.elf import functions
from injector.tracing.process import MemoryMapping
from injector.tracing.symbols import demangled, full_name, spellings


def rust(*parts: str) -> str:
    """The symbol of a path of Rust, mangled the legacy way."""
    whole = [*parts, "h0123456789abcdef"]
    return "_ZN" + "".join(f"{len(one)}{one}" for one in whole) + "E"


@pytest.mark.parametrize(
    ("symbol", "name"),
    [
        ("main", "main"),
        ("_ZN4grid6insertEdi", "grid::insert(double, int)"),
        (rust("core", "fmt", "write"), "core::fmt::write"),
        (
            rust("_$LT$std..io..error..Error$u20$as$u20$core..fmt..Display$GT$", "fmt"),
            "<std::io::error::Error as core::fmt::Display>::fmt",
        ),
        (rust("core", "ptr", "drop_in_place$LT$$RF$u8$C$$BP$u8$GT$"), "core::ptr::drop_in_place<&u8,*u8>"),
        ("_Znothing", "_Znothing"),
    ],
)
def test_a_symbol_is_shown_as_its_language_writes_it(symbol: str, name: str) -> None:
    assert demangled(symbol) == name


@pytest.mark.parametrize(
    ("symbol", "asked"),
    [
        (
            "_ZSt4swapIiEvRT_S1_",
            {"void std::swap<int>(int&,int&)", "std::swap<int>(int&,int&)", "std::swap<int>"},
        ),
        ("_ZN4grid6insertEdi", {"grid::insert(double,int)", "grid::insert"}),
        (rust("core", "fmt", "write"), {"core::fmt::write"}),
    ],
)
def test_a_function_is_found_with_and_without_return_type_and_parameters(
    symbol: str, asked: set[str]
) -> None:
    assert spellings(demangled(symbol)) == asked


@pytest.mark.parametrize(
    ("symbol", "name"),
    [
        ("work.part.0", "work"),
        ("work.constprop.1.isra.0", "work"),
        ("_ZN4grid6insertEdi.part.0", "grid::insert(double, int)"),
        ("_ZN4grid3MapC1Ei", "grid::Map::Map(int)"),
        ("_ZN4grid3MapC2Ei", "grid::Map::Map(int)"),
        ("work.of.somebody", "work.of.somebody"),
    ],
)
def test_variants_of_a_function_share_its_full_name(symbol: str, name: str) -> None:
    assert full_name(symbol) == name


def test_a_tag_of_the_abi_need_not_be_written() -> None:
    asked = spellings(demangled("_ZN4grid4nameB5cxx11Ei"))
    assert {"grid::name(int)", "grid::name", "grid::name[abi:cxx11](int)"} <= asked


def test_functions_of_a_file_whose_pieces_share_pages_are_found_where_they_lie(tmp_path: Path) -> None:
    """So link the linkers of Rust and LLVM: pieces follow one another within a page of the file."""
    names, text, page, base = b"\0work\0", 0x1100, 0x1000, 0x7F00_0000_0000
    kinds = {"header": 0x40, "symbols": 0x200, "names": 0x280, "sections": 0x300}
    segments = [(4, 0, 0, text), (5, text, text + page, 0x80), (6, text + 0x80, text + 2 * page + 0x80, 0x40)]
    file = bytearray(text + 0x100)
    file[:64] = struct.pack(
        "<16sHHIQQQIHHHHHH", b"\x7fELF\x02\x01\x01", 3, 62, 1, 0, 0x40, 0x300, 0, 64, 56, 3, 64, 3, 0
    )
    for number, (flags, start, virtual, size) in enumerate(segments):
        header = struct.pack("<IIQQQQQQ", 1, flags, start, virtual, virtual, size, size, page)
        file[kinds["header"] + 56 * number : kinds["header"] + 56 * (number + 1)] = header
    symbol = struct.pack("<IBBHQQ", 1, 2, 0, 1, text + page + 0x10, 8)
    file[kinds["symbols"] + 24 : kinds["symbols"] + 48] = symbol
    file[kinds["names"] : kinds["names"] + len(names)] = names
    sections = [(0, 0, 0, 0), (2, kinds["symbols"], 48, 2), (3, kinds["names"], len(names), 0)]
    for number, (kind, start, size, link) in enumerate(sections):
        at = kinds["sections"] + 64 * number
        file[at : at + 64] = struct.pack("<IIQQQQIIQQ", 0, kind, 0, 0, start, size, link, 0, 0, 0)
    (tmp_path / "program").write_bytes(file)
    code = MemoryMapping(base + 2 * page, base + 3 * page, page, str(tmp_path / "program"), "r-xp", "")
    assert dict(functions(os.getpid(), code)) == {"work": base + text + page + 0x10}
