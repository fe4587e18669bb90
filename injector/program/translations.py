"""The translations of a program's code that were made so far, and how a thread is led to them."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from contextlib import suppress

import numpy as np

from injector.block_profile.counted_call import BlockCounts, UncountableError
from injector.block_profile.translation_memory import SPAN, WRITABLE, TranslationMemory, map_at, map_near
from injector.block_profile.x86_64_translator import MOST_BYTES, TRAP, Exit, TranslationError
from injector.isa.x86_64_registers import X8664Registers
from injector.program.translator import (
    KEPT,
    SLOTS,
    TABLE_BYTES,
    TARGET_AT,
    THREAD_BYTES,
    WAYS,
    LeadTable,
    ProgramBlock,
    translate_program,
)
from injector.tracing import ptrace
from injector.tracing.process import MemoryMapping, Process

_TABLES = 0x10_0000_0000
"""Where the table and the threads' memory lie: no program of Linux has anything there by itself."""

_THREADS_AT = 2 * WAYS * TABLE_BYTES
_MOST_THREADS = 1 << 14


class ProgramTranslations:
    """The translations in one process, whose first thread stands; blocks are translated as they are met.

    ``stop_at`` is where a thread stands that has come to the stop; 0 before its block was met.
    """

    def __init__(self, process: Process, stop: tuple[int, int] | None) -> None:
        """Make room in a process for the table and the threads' memory.

        :raises UncountableError: if there is none.
        """
        self._process, self._stop = process, stop
        self.stop_at = 0
        self.behind_calls: dict[int, int] = {}
        self._memories: list[TranslationMemory] = []
        self._leads: dict[int, int] = {}
        self._misses: dict[int, int] = {}
        self._lies: dict[int, int] = {}
        self._clean: set[int] = set()
        self._exits: dict[int, Exit] = {}
        self._blocks: list[tuple[ProgramBlock, int]] = []
        self.sources: list[bytes] = []
        self._code: list[MemoryMapping] = []
        self._table, self._ways = LeadTable(_TABLES), Counter[int]()
        self._thread_memory: dict[int, int] = {}
        size = _THREADS_AT + _MOST_THREADS * THREAD_BYTES
        if not map_at(process.pid, process, _TABLES, size, WRITABLE):
            raise UncountableError("the program's memory is where translations are to be")

    @property
    def threads(self) -> int:
        """How many threads were given memory."""
        return len(self._thread_memory)

    def give_memory(self, tid: int) -> None:
        """Give a thread the memory in which its registers are kept, unless it has some.

        :raises UncountableError: if there are too many.
        """
        if tid in self._thread_memory:
            return
        if self.threads >= _MOST_THREADS:
            message = f"the program has more than {_MOST_THREADS} threads"
            raise UncountableError(message)
        at = self._thread_memory[tid] = _TABLES + _THREADS_AT + self.threads * THREAD_BYTES
        registers = X8664Registers(tid)
        registers.put("gs_base", at)
        registers.commit()

    def is_clean(self, address: int) -> bool:
        """Whether none of our own instructions is under way in who stands there."""
        return address in self._clean or not self.is_translation(address)

    def lead_on(self, tid: int) -> bool:
        """Lead on a thread that stands behind a trap of ours; False if it is none."""
        trap = ptrace.program_counter(tid) - len(TRAP)
        exit_ = self._exits.get(trap)
        if exit_ is not None:
            where = self.translated(exit_.target)
            with suppress(TranslationError):  # too far away: it is trapped each time
                self._process.write_memory(exit_.field, exit_.leading_to(where))
            ptrace.go_to(tid, where)
            return True
        if trap not in self._misses:
            return False
        kept = self._process.read_memory(self._thread_memory[tid], THREAD_BYTES)
        address = _word(kept, TARGET_AT)
        where = self.translated(address)
        registers = X8664Registers(tid)
        for name, at in KEPT.items():
            registers.put(name, _word(kept, at))
        registers.put("rip", where)
        registers.commit()
        way = self._ways[address % SLOTS]
        if where != address and way < WAYS:
            self._ways[address % SLOTS] += 1
            for place, content in self._table.entry(address, where, way):
                self._process.write_memory(place, content)
        return True

    def translated(self, address: int) -> int:
        """Where the translation of the block at an address lies; the address itself if there is no code."""
        if address in self._lies:
            return self._lies[address]
        mapping = self._mapping_of(address)
        if mapping is None:
            return address
        if "w" in mapping.permissions or not mapping.path:
            message = f"the program makes code while it runs ({mapping.name or 'memory'} at {address:#x})"
            raise UncountableError(message)
        code = self._process.read_memory(address, min(MOST_BYTES, mapping.end - address))
        memory = self._memory_of(mapping.start)
        at, passes = memory.here, memory.words(1)
        self.sources.append(code)
        leaders = () if self._stop is None else (self._stop[0],)
        remaining = memory.words(1) if address in leaders else 0
        if self._stop is not None and remaining:
            self._process.write_memory(remaining, self._stop[1].to_bytes(8, "little"))
        made = translate_program(code, address, at, passes, self._leads[memory.start], leaders, remaining)
        if made.stop:
            self.stop_at = at + made.stop
        memory.take(len(made.code))
        self._process.write_memory(at, made.code)
        self._blocks.append((made, passes))
        self._exits |= {one.trap: one for one in made.exits}
        self._clean |= {at, *(at + offset for offset in made.clean), *(one.trap for one in made.exits)}
        if made.after_call:
            self.behind_calls[at + made.after_call] = made.exits[-1].target
            self._clean.add(at + made.after_call)
        self._lies[address] = at
        return at

    def is_translation(self, address: int) -> bool:
        """Whether an address lies in a translation, or in the code that leads there."""
        return any(memory.code <= address < memory.here for memory in self._memories)

    def counts(self) -> BlockCounts:
        """How often each block was passed so far, in the order in which they were met first."""
        passes = np.zeros(len(self._blocks), np.int64)
        at = np.array([word for _, word in self._blocks], np.int64)
        for memory in self._memories:
            begin, end = memory.words_in_use
            words = np.frombuffer(self._process.read_memory(begin, end - begin), np.int64)
            there = (at >= begin) & (at < end)
            passes[there] = words[at[there] - begin >> 3]
        first = np.array([block.instructions[0] for block, _ in self._blocks], np.uint64)
        return BlockCounts(tuple(block.instructions for block, _ in self._blocks), first, passes, passes)

    def _mapping_of(self, address: int) -> MemoryMapping | None:
        """The piece of code that an address lies in; None if there is none."""
        for _ in range(2):
            index = bisect_right(self._code, address, key=lambda one: one.start) - 1
            if index >= 0 and address < self._code[index].end:
                return self._code[index]
            self._code = sorted(self._process.maps().code(), key=lambda one: one.start)
        return None

    def _memory_of(self, start: int) -> TranslationMemory:
        """Memory for translations near a piece of code that begins at ``start``."""
        for memory in self._memories:
            if abs(start - memory.start) < SPAN:
                return memory
        memory = map_near(self._process.pid, self._process, start)
        code, miss = self._table.code()
        at = memory.here
        memory.take(len(code))
        self._process.write_memory(at, code)
        self._leads[memory.start] = at
        self._misses[at + miss - len(TRAP)] = at
        self._memories.append(memory)
        return memory


def _word(content: bytes, at: int) -> int:
    return int.from_bytes(content[at : at + 8], "little")
