"""Pointers are told by what they point into, numbers by themselves."""

import pytest

from injector.flight.fingerprint import Pointers
from injector.tracing.process import MemoryMap

MAPS = """\
555555554000-555555600000 r-xp 00002000 08:01 10 /opt/python3/lib/liboctomap.so
555555a00000-555555b00000 rw-p 00000000 00:00 0 [heap]
7ffff7000000-7ffff7100000 rw-p 00000000 00:00 0
7ffffffde000-7ffffffff000 rw-p 00000000 00:00 0 [stack]
"""
STACK = 0x7FFFFFFFE000


@pytest.fixture
def pointers() -> Pointers:
    return Pointers(MemoryMap(MAPS), STACK)


def test_a_pointer_into_a_file_is_told_by_the_files_name_and_offset(pointers: Pointers) -> None:
    assert pointers.target(0x555555554010) == "liboctomap.so+0x2010"


def test_a_pointer_into_the_stack_is_told_by_its_distance_from_the_top(pointers: Pointers) -> None:
    assert pointers.target(STACK + 24) == "stack+24"
    assert pointers.target(STACK - 8) == "stack-8"


@pytest.mark.parametrize("address", [0x555555A00128, 0x7FFFF7000FF8])
def test_of_other_memory_only_the_alignment_is_told(pointers: Pointers, address: int) -> None:
    assert pointers.target(address) == "memory, 8 modulo 16"
    assert pointers.target(address + 4096) == pointers.target(address) != pointers.target(address + 8)


@pytest.mark.parametrize("number", [0, 1, 2**64 - 1, 0x555555600000, 0x3FF0000000000000])
def test_a_number_points_into_nothing(pointers: Pointers, number: int) -> None:
    assert not pointers.target(number)
