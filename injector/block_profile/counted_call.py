"""A call that is run block by block in translation, so that the passes through every instruction are counted.

The copy of a node that runs it finds a trap wherever code in question lies. Who arrives at one is sent on to
a translation of the block there (:mod:`injector.block_profile.x86_64_translator`), which is made then; blocks
that follow one another are linked, so that each is trapped at but once or twice. Code that is not in question
runs as it is. The call can be stopped before drawn passes. x86-64 only; the process has one thread.
"""

from __future__ import annotations

import os
import signal
import struct
import threading
from bisect import bisect_right
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

MOST_TRAPS = 250_000
"""Traps after which a call is given up: its blocks do not lead to one another (others have 5,000 to 100,000).

A number and no time, so that it does not depend on the machine which calls can be counted.
"""

_WORD = struct.Struct("<Q")


class UncountableError(Exception):
    """The call does not come to its end in translation: one line."""


@dataclass(frozen=True, slots=True)
class BlockCounts:
    """How often each block was passed so far, in the order in which they were met first.

    ``instructions`` has the addresses of each, ``leaders`` the first of these. ``noted`` says how often the
    watched address had been passed at the last pass of each (no meaning where none is watched).
    """

    instructions: tuple[tuple[int, ...], ...]
    leaders: NDArray[np.uint64]
    passes: NDArray[np.int64]
    noted: NDArray[np.int64]


class CountedCall:
    """The call at whose beginning a copy stands; the copy is of no use after it."""

    def __init__(
        self,
        thread: Tracee,
        process: Process,
        code: Sequence[tuple[int, int]],
        *,
        leaders: Collection[int] = frozenset(),
        stops: Mapping[int, Sequence[int]] | None = None,
    ) -> None:
        """Make ready to count in ``code``, ranges in order.

        Blocks end before each of ``leaders`` at the latest. ``stops`` are the passes, in order and from 1 on,
        before which the call is to stop, by their addresses, which must be among ``leaders``.

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
        self._at = np.empty((0, 2), np.int64)
        self._first = np.empty(0, np.uint64)
        self._exits: dict[int, Exit] = {}
        self._left = {address: list(passes) for address, passes in (stops or {}).items()}
        self._watched = self._memories[0].words(1) if stops else 0
        self._stop_counters = {address: self._prepare_stop(address) for address in self._left}
        self._stops_at: dict[int, int] = {}
        if self._left:
            self.watch(next(iter(self._left)))
        self._begun, self._traps = False, 0
        for start, end in code:
            process.write_memory(start, TRAP * (end - start))

    def _prepare_stop(self, address: int) -> Counters:
        memory = self._memory_of(address)
        passes, remaining = memory.words(1), memory.words(1)
        self._process.write_memory(remaining, _WORD.pack(self._left[address][0]))
        return Counters(passes, memory.scratch, memory.words(1), self._watched, remaining)

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

    def run(self, mark: int) -> BlockCounts:
        """Run to the signal ``mark``, which ends the call; what was passed.

        :raises UncountableError: if it does not come.
        :raises GoneError: if somebody kills the process.
        """
        self.to_next_stop(mark)
        return self.counts()

    def watch(self, address: int) -> None:
        """Have every block note from now on how often one of the stops' addresses was passed."""
        self._process.write_memory(self._watched, _WORD.pack(self._stop_counters[address].passes))

    def to_next_stop(self, mark: int) -> tuple[int, int] | None:
        """Run to the next stop, before the instruction there: address and number of the pass.

        None at the call's end, which the signal ``mark`` tells.

        :raises UncountableError, GoneError: as :meth:`run` does.
        """
        with self._limited():
            return self._run(mark)

    def counts(self) -> BlockCounts:
        """How often each block was passed so far."""
        if len(self._at) < len(self._blocks):
            words = [(one.passes, one.noted or one.passes) for _, one in self._blocks]
            self._at = np.array(words, np.int64).reshape(-1, 2)
            self._first = np.array([block.instructions[0] for block, _ in self._blocks], np.uint64)
        found = np.zeros_like(self._at)
        for memory in self._memories:
            begin, end = memory.words_in_use
            words_there = np.frombuffer(self._process.read_memory(begin, end - begin), np.int64)
            there = (self._at >= begin) & (self._at < end)
            found[there] = words_there[self._at[there] - begin >> 3]
        return BlockCounts(
            tuple(block.instructions for block, _ in self._blocks), self._first, found[:, 0], found[:, 1]
        )

    @contextmanager
    def _limited(self) -> Iterator[None]:
        watchdog = threading.Timer(LIMIT_S, os.kill, (self._process.pid, signal.SIGKILL))
        watchdog.start()
        try:
            yield
        except (TranslationError, TranslationMemoryError) as error:
            raise UncountableError(str(error)) from error
        finally:
            watchdog.cancel()
            watchdog.join()

    def _run(self, mark: int) -> tuple[int, int] | None:
        tid = self._thread.tid
        at = ptrace.program_counter(tid)
        if not self._begun and self._in_question(at):
            ptrace.go_to(tid, self._translated(at))
        self._begun = True
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
                return None
            if report.kind == "signal" and report.signal == signal.SIGTRAP:
                address = self._stops_at.get(ptrace.program_counter(tid))
                if address is not None:
                    return address, self._passed_stop(address)
                self._lead_on()
            elif report.kind == "signal" and report.signal in {*FAULTS, signal.SIGABRT}:
                message = f"the call does not run in translation: signal {report.signal}"
                raise UncountableError(message)
            elif report.kind == "signal":
                number = report.signal

    def _passed_stop(self, address: int) -> int:
        """The number of the pass before which the call stopped; the next one at this address is awaited."""
        hit, *left = self._left[address]
        self._left[address] = left
        after = left[0] - hit if left else 0  # counts down from there: it does not come to zero again
        self._process.write_memory(self._stop_counters[address].remaining, _WORD.pack(after))
        return hit

    def _lead_on(self) -> None:
        """Lead on who stands behind a trap."""
        self._traps += 1
        if self._traps > MOST_TRAPS:
            message = f"the call does not run in translation: more than {MOST_TRAPS} traps"
            raise UncountableError(message)
        trap = ptrace.program_counter(self._thread.tid) - len(TRAP)
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

    def _translated(self, address: int) -> int:
        """Where the translation of the block at an address lies; made if there is none yet."""
        if address in self._lies:
            return self._lies[address]
        memory = self._memory_of(address)
        at = memory.here
        counters = self._stop_counters.get(address) or Counters(
            memory.words(1), memory.scratch, memory.words(1) if self._watched else 0, self._watched
        )
        made = translate(self._bytes(address, MOST_BYTES), address, at, counters, self._leaders)
        memory.take(len(made.code))
        self._process.write_memory(at, made.code)
        if made.takes_a_jump:
            self._process.write_memory(address, jump(address, at))
        if made.stop:
            self._stops_at[made.stop] = address
        self._exits |= {one.trap: one for one in made.exits}
        self._blocks.append((made, counters))
        self._lies[address] = at
        return at

    def _memory_of(self, address: int) -> TranslationMemory:
        return self._memories[bisect_right(self._memories, address, key=lambda one: one.start) - 1]
