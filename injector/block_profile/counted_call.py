"""A call that is run block by block in translation, so that the passes through every instruction are counted.

The copy of a node that runs it finds a trap wherever code in question lies. Who arrives at one is sent on to
a translation of the block there (:mod:`injector.block_profile.x86_64_translator`), which is made then; blocks
that follow one another are linked, so that each is trapped at but once or twice. Code that is not in question
runs as it is. x86-64 only; the process has one thread.
"""

from __future__ import annotations

import os
import signal
import struct
import threading
from bisect import bisect_right
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from injector.block_profile.translation_memory import TranslationMemory, TranslationMemoryError, map_memory
from injector.block_profile.x86_64_translator import (
    MOST_BYTES,
    TRAP,
    Counters,
    Exit,
    Translation,
    TranslationError,
    jump,
    translate,
)
from injector.tracing import ptrace
from injector.tracing.process import LONGEST_INSTRUCTION, Process
from injector.tracing.ptrace import StopReport
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import FAULTS

LIMIT_S = 60.0
"""Wall time after which the process is killed."""

_WORD = struct.Struct("<Q")


class UncountableError(Exception):
    """The call does not come to its end in translation: one line."""


@dataclass(frozen=True, slots=True)
class CountedBlock:
    """A block that was passed so often: its ``instructions``, and at its last pass ``noted``."""

    instructions: tuple[int, ...]
    passes: int
    noted: int


class CountedCall:
    """The call at whose beginning a copy stands; the copy is of no use after it."""

    def __init__(
        self,
        thread: Tracee,
        process: Process,
        code: Sequence[tuple[int, int]],
        *,
        leaders: Collection[int] = frozenset(),
        stop: tuple[int, int] | None = None,
    ) -> None:
        """Make ready to count in ``code``, ranges in order.

        Blocks end before each of ``leaders`` at the latest. With a ``stop``, one of these and a number, the
        call ends before that pass through it, and every block notes how often it was passed before.

        :raises UncountableError: if there is no room for translations.
        """
        self._thread, self._process, self._leaders = thread, process, leaders
        self._ranges = list(code)
        self._starts = [start for start, _ in code]
        self._code = [process.read_memory(start, end - start) for start, end in code]
        try:
            self._memories = map_memory(thread.tid, process, code)
        except TranslationMemoryError as error:
            raise UncountableError(str(error)) from error
        self._lies: dict[int, int] = {}
        self._blocks: list[tuple[Translation, Counters]] = []
        self._exits: dict[int, Exit] = {}
        self._stop, self._stopped_at = stop, 0
        self._of = 0
        if stop is not None:
            self._stop_counters = self._prepare_stop(*stop)
        for start, end in code:
            process.write_memory(start, TRAP * (end - start))

    def _prepare_stop(self, address: int, hit: int) -> Counters:
        memory = self._memory_of(address)
        passes, remaining = memory.words(1), memory.words(1)
        self._of = passes
        self._process.write_memory(remaining, _WORD.pack(hit))
        return Counters(passes, memory.scratch, remaining=remaining)

    def code_at(self, address: int) -> bytes:
        """The true bytes of the longest instruction that may begin at an address in question."""
        return self._bytes(address, LONGEST_INSTRUCTION)

    def _bytes(self, address: int, most: int) -> bytes:
        index = bisect_right(self._starts, address) - 1
        begin = address - self._starts[index]
        return self._code[index][begin : begin + most]

    def _in_question(self, address: int) -> bool:
        index = bisect_right(self._starts, address) - 1
        return index >= 0 and address < self._ranges[index][1]

    def run(self, mark: int) -> list[CountedBlock]:
        """Run to the signal ``mark``, or to the stop; what was passed.

        :raises UncountableError: if neither comes.
        :raises GoneError: if somebody kills the process.
        """
        watchdog = threading.Timer(LIMIT_S, os.kill, (self._process.pid, signal.SIGKILL))
        watchdog.start()
        try:
            self._run(mark)
        except (TranslationError, TranslationMemoryError) as error:
            raise UncountableError(str(error)) from error
        finally:
            watchdog.cancel()
            watchdog.join()
        return [self._passed(block, counters) for block, counters in self._blocks]

    def _run(self, mark: int) -> None:
        tid = self._thread.tid
        at = ptrace.program_counter(tid)
        if self._in_question(at):
            ptrace.go_to(tid, self._translated(at))
        number = 0
        while True:
            ptrace.resume(tid, number)
            report = ptrace.await_report(tid)
            self._thread.report = StopReport("step") if report.kind != "gone" else report
            number = 0
            if report.kind == "gone":
                message = f"process {tid} was killed in a counted call"
                raise ptrace.GoneError(message)
            if report.kind == "signal" and report.signal == mark:
                if self._stop is not None:
                    raise UncountableError("the call ended before the pass that another copy made")
                return
            if report.kind == "signal" and report.signal == signal.SIGTRAP:
                if self._next():
                    return
            elif report.kind == "signal" and report.signal in {*FAULTS, signal.SIGABRT}:
                message = f"the call does not run in translation: signal {report.signal}"
                raise UncountableError(message)
            elif report.kind == "signal":
                number = report.signal

    def _next(self) -> bool:
        """Lead on who stands behind a trap; whether it is the stop's."""
        after = ptrace.program_counter(self._thread.tid)
        if after == self._stopped_at:
            return True
        trap = after - len(TRAP)
        exit_ = self._exits.get(trap)
        if exit_ is not None:
            target = exit_.target
            where = self._translated(target) if self._in_question(target) else target
            self._process.write_memory(exit_.field, exit_.leading_to(where))
        elif self._in_question(trap):
            where = self._translated(trap)
        else:
            message = f"the call does not run in translation: a trap at {trap:#x}"
            raise UncountableError(message)
        ptrace.go_to(self._thread.tid, where)
        return False

    def _translated(self, address: int) -> int:
        """Where the translation of the block at an address lies; made if there is none yet."""
        if address in self._lies:
            return self._lies[address]
        memory = self._memory_of(address)
        at = memory.here
        if self._stop is not None and address == self._stop[0]:
            counters = self._stop_counters
        else:
            noted = memory.words(1) if self._of else 0
            counters = Counters(memory.words(1), memory.scratch, noted, self._of)
        made = translate(self._bytes(address, MOST_BYTES), address, at, counters, self._leaders)
        memory.take(len(made.code))
        self._process.write_memory(at, made.code)
        if made.takes_a_jump:
            self._process.write_memory(address, jump(address, at))
        self._stopped_at = made.stop or self._stopped_at
        self._exits |= {one.trap: one for one in made.exits}
        self._blocks.append((made, counters))
        self._lies[address] = at
        return at

    def _memory_of(self, address: int) -> TranslationMemory:
        return self._memories[bisect_right(self._memories, address, key=lambda one: one.start) - 1]

    def _passed(self, block: Translation, counters: Counters) -> CountedBlock:
        return CountedBlock(block.instructions, self._word(counters.passes), self._word(counters.noted))

    def _word(self, address: int) -> int:
        (value,) = _WORD.unpack(self._process.read_memory(address, _WORD.size)) if address else (0,)
        return int(value)
