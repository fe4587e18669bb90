"""Places in code of files whose pages hold two segments, as LLD lays them (and so Rust, by default)."""

import os
import struct
from pathlib import Path

import pytest

from injector.tracing.elf import CodeLocations, locate
from injector.tracing.process import MemoryMap


@pytest.fixture
def loaded(tmp_path: Path) -> MemoryMap:
    """The map of a file of which constants and code share the page of 0x0 to 0x1000."""
    head = b"\x7fELF\x02\x01\x01".ljust(16, b"\0")
    head += struct.pack("<HHIQQQIHHHHHH", 3, 62, 1, 0, 64, 0, 0, 64, 56, 2, 64, 0, 0)
    constants = struct.pack("<IIQQQQQQ", 1, 4, 0, 0, 0, 0x160, 0x160, 0x1000)
    code = struct.pack("<IIQQQQQQ", 1, 5, 0x160, 0x1160, 0x1160, 0x100, 0x100, 0x1000)
    file = tmp_path / "laid_by_lld"
    file.write_bytes((head + constants + code).ljust(0x260, b"\x90"))
    return MemoryMap(f"10000-11000 r--p 0 0:0 1 {file}\n11000-12000 r-xp 0 0:0 1 {file}\n")


def test_code_has_the_address_that_objdump_shows(loaded: MemoryMap) -> None:
    places = CodeLocations(os.getpid(), loaded)
    assert [places.at(one).offset for one in (0x11000, 0x11160, 0x1125F)] == [0x1000, 0x1160, 0x125F]


def test_code_is_found_again(loaded: MemoryMap) -> None:
    assert locate(os.getpid(), loaded, "laid_by_lld", "", 0x1164) == 0x11164
