"""Memory for translations in a process that stands and is traced: one piece near each cluster of its code.

It is mapped where the process itself would map nothing for a long time, so that its own memory comes to lie
where it would without.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from injector.block_profile.injected_call import injected_call
from injector.tracing.process import Process

_MMAP = 9  # the number of the system call on x86-64
EXECUTABLE, WRITABLE = mmap.PROT_READ | mmap.PROT_EXEC, mmap.PROT_READ | mmap.PROT_WRITE
_FLAGS = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | 0x100000  # MAP_FIXED_NOREPLACE
_NO_FILE = 2**64 - 1

_CODE_SIZE, _DATA_SIZE = 32 << 20, 4 << 20
SPAN = 1 << 30
"""Longest cluster: with its memory, everything is within the reach of a displacement."""

_PLACES = (-600 << 20, -64 << 20, -900 << 20, SPAN + (64 << 20))
"""Where the memory of a cluster may lie, from its beginning; the first that is free."""

_WORD = struct.Struct("<Q")
_HEAD = 64
_ALIGNED = 16


class TranslationMemoryError(Exception):
    """The process has no room for translations: one line."""


@dataclass
class TranslationMemory:
    """The piece for the code from ``start`` on: translations from ``code`` on, words from ``data`` on."""

    start: int
    code: int
    data: int
    _next_code: int = field(init=False)
    _next_data: int = field(init=False)

    def __post_init__(self) -> None:
        self._next_code, self._next_data = self.code, self.data + _HEAD

    @property
    def scratch(self) -> int:
        """The address of two words for registers."""
        return self.data

    @property
    def here(self) -> int:
        """Where the next translation comes to lie."""
        return self._next_code

    def take(self, size: int) -> None:
        """Take the memory of the next translation.

        :raises TranslationMemoryError: if there is no more.
        """
        self._next_code += -(-size // _ALIGNED) * _ALIGNED
        if self._next_code > self.code + _CODE_SIZE:
            raise TranslationMemoryError("a call runs more code than there is room for")

    @property
    def words_in_use(self) -> tuple[int, int]:
        """Where the words that were taken begin and end."""
        return self.data, self._next_data

    def words(self, number: int) -> int:
        """The address of so many new words, zero at first."""
        address = self._next_data
        self._next_data += number * _WORD.size
        if self._next_data > self.data + _DATA_SIZE:
            raise TranslationMemoryError("a call runs more blocks than there is room for")
        return address


def map_memory(tid: int, process: Process, code: Sequence[tuple[int, int]]) -> list[TranslationMemory]:
    """Map memory for the translations of code, which lies in these ranges, in order.

    :raises TranslationMemoryError: if there is no room.
    """
    return [map_near(tid, process, start) for start in _clusters(code)]


def _clusters(code: Sequence[tuple[int, int]]) -> Iterator[int]:
    """Where each cluster of code begins: what lies within a displacement of one piece of memory."""
    begin = -SPAN
    for start, end in code:
        if end - begin > SPAN:
            begin = start
            yield start


def map_near(tid: int, process: Process, start: int) -> TranslationMemory:
    """Map memory for the translations of code that lies from ``start`` on.

    :raises TranslationMemoryError: if there is no room.
    """
    for distance in _PLACES:
        at = (start + distance) // mmap.PAGESIZE * mmap.PAGESIZE
        if at <= 0:
            continue
        if map_at(tid, process, at, _CODE_SIZE, EXECUTABLE) and map_at(
            tid, process, at + _CODE_SIZE, _DATA_SIZE, WRITABLE
        ):
            return TranslationMemory(start, at, at + _CODE_SIZE)
    message = f"process {process.pid} has no room near {start:#x} for {_CODE_SIZE + _DATA_SIZE} bytes"
    raise TranslationMemoryError(message)


def map_at(tid: int, process: Process, at: int, size: int, protection: int) -> bool:
    """Have the thread map memory at an address; whether it did."""
    return injected_call(tid, process, _MMAP, at, size, protection, _FLAGS, _NO_FILE, 0) == at
