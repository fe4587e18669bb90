"""A call that is run block by block in translation, so that the passes through every instruction are counted.

The copy of a node that runs it (:mod:`injector.block_profile.translated_code`) is of no use after it. It can
be stopped before drawn passes.
"""

from __future__ import annotations

import os
import signal
import struct
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from injector.block_profile.translated_code import TranslatedCode
from injector.block_profile.translation_memory import TranslationMemory, TranslationMemoryError
from injector.block_profile.x86_64_translator import Counters, Translation, TranslationError, translate
from injector.tracing import ptrace
from injector.tracing.process import Process
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


class CountedCall(TranslatedCode):
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

        Blocks end before each of ``leaders`` and ``stops`` at the latest. ``stops`` are the passes, in order
        and from 1 on, before which the call is to stop, by their addresses.

        :raises UncountableError: if there is no room for translations.
        """
        try:
            super().__init__(thread, process, code)
        except TranslationMemoryError as error:
            raise UncountableError(str(error)) from error
        self._stops = frozenset(stops or ())
        self._leaders = self._stops | frozenset(leaders)
        self._arrived_at = frozenset(leaders)
        self._blocks: list[tuple[Translation, Counters]] = []
        self._at = np.empty((0, 2), np.int64)
        self._first = np.empty(0, np.uint64)
        self._left = {address: list(passes) for address, passes in (stops or {}).items()}
        self._watched = self._memories[0].words(1) if stops else 0
        self._stop_counters = {address: self._prepare_stop(address) for address in self._left}
        self._stops_at: dict[int, int] = {}
        if self._left:
            self.watch(next(iter(self._left)))
        self._begun, self._traps = False, 0
        self.limit_s = LIMIT_S
        self.overwrite()

    def _prepare_stop(self, address: int) -> Counters:
        memory = self._memory_of(address)
        passes, remaining = memory.words(1), memory.words(1)
        self._process.write_memory(remaining, _WORD.pack(self._left[address][0]))
        return Counters(passes, memory.scratch, memory.words(1), self._watched, remaining)

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
        watchdog = threading.Timer(self.limit_s, os.kill, (self._process.pid, signal.SIGKILL))
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
            report = self._next_report(number)
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
                self._lead_on_or_give_up()
            elif report.kind == "signal" and report.signal in {*FAULTS, signal.SIGABRT}:
                message = f"the call does not run in translation: signal {report.signal}"
                raise UncountableError(message)
            elif report.kind == "signal":
                number = report.signal

    def _next_report(self, number: int) -> StopReport:
        """Let the copy run, with a signal if there is one; what it reports then."""
        ptrace.resume(self._thread.tid, number)
        return ptrace.await_report(self._thread.tid)

    def _passed_stop(self, address: int) -> int:
        """The number of the pass before which the call stopped; the next one at this address is awaited."""
        hit, *left = self._left[address]
        self._left[address] = left
        after = left[0] - hit if left else 0  # counts down from there: it does not come to zero again
        self._process.write_memory(self._stop_counters[address].remaining, _WORD.pack(after))
        return hit

    def _lead_on_or_give_up(self) -> None:
        """Lead on who stands behind a trap."""
        self._traps += 1
        if self._traps > MOST_TRAPS:
            message = f"the call does not run in translation: more than {MOST_TRAPS} traps"
            raise UncountableError(message)
        trap = ptrace.program_counter(self._thread.tid) - 1
        if not self._lead_on(self._thread.tid):
            message = f"the call does not run in translation: a trap at {trap:#x}"
            raise UncountableError(message)

    def _make(self, address: int, memory: TranslationMemory) -> Translation:
        counters = self._stop_counters.get(address) or Counters(
            memory.words(1), memory.scratch, memory.words(1) if self._watched else 0, self._watched
        )
        made = translate(self._block_at(address), address, memory.here, counters, self._leaders)
        if made.stop:
            self._stops_at[made.stop] = address
        if address in self._stops - self._arrived_at:
            # A place in the middle of other code, whose beginning has more need of a jump.
            made = replace(made, takes_a_jump=False)
        self._blocks.append((made, counters))
        return made
