"""Exceptions of C++ out of code in translation: the unwinder is shown the true return addresses.

It finds out by return addresses whom it is to unwind, and knows of no translation. So whoever enters it is
trapped, and those addresses on its stack that lead to translations are replaced by those that they stand for.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from injector.block_profile.x86_64_translator import TRAP
from injector.isa.x86_64_registers import X8664Registers
from injector.tracing import ptrace
from injector.tracing.elf import functions
from injector.tracing.process import Process

_LIBRARY = "libgcc_s"
_ENTRIES = frozenset(
    f"_Unwind_{name}"
    for name in ("RaiseException", "Resume", "Resume_or_Rethrow", "ForcedUnwind", "Backtrace")
)
_WORD = np.dtype("<u8")


class TrappedUnwinder:
    """The unwinder of a process, which traps whoever enters it."""

    def __init__(self, process: Process) -> None:
        maps = process.maps()
        self._true = {
            address: process.read_memory(address, len(TRAP))
            for mapping in maps.code()
            if Path(mapping.path).name.startswith(_LIBRARY)
            for name, address in functions(process.pid, mapping)
            if name in _ENTRIES
        }
        for address in self._true:
            process.write_memory(address, TRAP)

    def is_entered(self, trap: int) -> bool:
        """Whether a trap is one of these."""
        return trap in self._true

    def enter(self, tid: int, process: Process, trap: int, returns: Mapping[int, int]) -> None:
        """Have a thread go on from a trap, once it has the return addresses that others stand for."""
        _replace_returns(tid, process, returns)
        ptrace.go_to(tid, trap)
        with process.changed_code(trap, self._true[trap], TRAP):
            ptrace.step(tid)
            ptrace.await_report(tid)


def _replace_returns(tid: int, process: Process, returns: Mapping[int, int]) -> None:
    top = X8664Registers(tid).stack_pointer
    mapping = process.maps().at(top)
    if mapping is None or not returns:
        return
    size = (mapping.end - top) // _WORD.itemsize * _WORD.itemsize
    stack = np.frombuffer(process.read_memory(top, size), _WORD)
    for place in np.flatnonzero((stack >= min(returns)) & (stack <= max(returns))):
        true = returns.get(int(stack[place]))
        if true is not None:
            process.write_memory(top + int(place) * _WORD.itemsize, true.to_bytes(_WORD.itemsize, "little"))
