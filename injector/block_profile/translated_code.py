"""Code of a traced process that runs block by block in translation; blocks are translated as they are met.

The process finds a trap wherever code in question lies. Who arrives at one is led on to a translation of the
block there (:mod:`injector.block_profile.x86_64_translator`), which is made then; blocks that follow one
another are linked, so that each is trapped at but once or twice. Code that is not in question runs as it is.
x86-64 only; the process has one thread.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Sequence

from injector.block_profile.translation_memory import TranslationMemory, map_memory
from injector.block_profile.x86_64_translator import MOST_BYTES, TRAP, Exit, Translation, jump
from injector.tracing import ptrace
from injector.tracing.process import LONGEST_INSTRUCTION, Process
from injector.tracing.tracee import Tracee


class TranslatedCode(ABC):
    """The code in question of one process, its translations so far, and how a thread is led to them."""

    def __init__(self, thread: Tracee, process: Process, code: Sequence[tuple[int, int]]) -> None:
        """Make room for translations of ``code``, ranges in order; nothing is led anywhere yet.

        :raises TranslationMemoryError: if there is no room.
        """
        self._thread, self._process = thread, process
        self._ranges = list(code)
        self._starts = [start for start, _ in code]
        self._code = [process.read_memory(start, end - start) for start, end in code]
        self._memories = map_memory(thread.tid, process, code)
        self._lies: dict[int, int] = {}
        self._exits: dict[int, Exit] = {}
        self._jumps: set[int] = set()

    def overwrite(self) -> None:
        """Put traps wherever code in question lies: from now on it runs in translation."""
        for start, end in self._ranges:
            self._write(start, TRAP * (end - start))

    @abstractmethod
    def _make(self, address: int, memory: TranslationMemory) -> Translation:
        """The translation of the block at an address, for where the memory has room.

        :raises TranslationError: if there is none.
        """

    def _write(self, address: int, content: bytes) -> None:
        self._process.write_memory(address, content)

    def code_at(self, address: int) -> bytes:
        """The true bytes of the longest instruction that may begin at an address in question."""
        return self._bytes(address, LONGEST_INSTRUCTION)

    def _block_at(self, address: int) -> bytes:
        return self._bytes(address, MOST_BYTES)

    def _bytes(self, address: int, most: int) -> bytes:
        index = bisect_right(self._starts, address) - 1
        begin = address - self._starts[index]
        return self._code[index][begin : begin + most]

    def _in_question(self, address: int) -> bool:
        index = bisect_right(self._starts, address) - 1
        return index >= 0 and address < self._ranges[index][1]

    def _lead_on(self, tid: int) -> bool:
        """Lead on a thread that stands behind a trap; False if that is none of ours."""
        trap = ptrace.program_counter(tid) - len(TRAP)
        exit_ = self._exits.get(trap)
        if exit_ is not None:
            target = exit_.target
            where = self._translated(target) if self._in_question(target) else target
            self._write(exit_.field, exit_.leading_to(where))
        elif self._in_question(trap):
            where = self._translated(trap)
        else:
            return False
        ptrace.go_to(tid, where)
        return True

    def _translated(self, address: int) -> int:
        """Where the translation of the block at an address lies; made if there is none yet."""
        if address in self._lies:
            return self._lies[address]
        memory = self._memory_of(address)
        at = memory.here
        made = self._make(address, memory)
        memory.take(len(made.code))
        self._write(at, made.code)
        if made.takes_a_jump and not self._is_near_a_jump(address):
            self._write(address, jump(address, at))
            self._jumps.add(address)
        self._exits |= {one.trap: one for one in made.exits}
        self._lies[address] = at
        return at

    def _is_near_a_jump(self, address: int) -> bool:
        """Whether a jump at an address would overlap another one."""
        length = len(jump(0, 0))
        return any(other in self._jumps for other in range(address - length + 1, address + length))

    def _memory_of(self, address: int) -> TranslationMemory:
        return self._memories[bisect_right(self._memories, address, key=lambda one: one.start) - 1]
