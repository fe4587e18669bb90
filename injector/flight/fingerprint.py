"""Fingerprints of dynamic instructions: the bytes, and hashes of the registers that are read."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from injector.faults.stopped_thread import stand
from injector.tracing.process import MemoryMap, Process
from injector.tracing.tracee import Tracee

_ALIGNMENT = 16
"""Of what malloc gives: an address in allocated memory is the same modulo this, wherever the memory lies."""


@dataclass(frozen=True, slots=True)
class Fingerprint:
    """What a thread is about to execute; all hexadecimal.

    ``code`` has the bytes of the instruction, ``registers`` a hash of the registers that it reads, and
    ``relative`` another one, the same wherever memory lies: pointers are told by :class:`Pointers`.
    """

    code: str
    registers: str
    relative: str


class Pointers:
    """Tells by what they point into which values of a process are pointers, at one moment of it."""

    def __init__(self, maps: MemoryMap, stack: int) -> None:
        """Take the memory map, and the stack pointer of the thread."""
        self._maps, self._stack = maps, stack
        self._on_stack = maps.at(stack)

    def target(self, value: int) -> str:
        """What ``value`` points into, told in a way that does not depend on where memory lies; else empty.

        A place in a file is told by its name and offset, one on the thread's own stack by its distance from
        the stack pointer, one in other memory by the alignment of allocations.
        """
        mapping = self._maps.at(value)
        if mapping is None:
            return ""
        if mapping == self._on_stack:
            return f"stack{value - self._stack:+d}"
        if mapping.path:
            return f"{Path(mapping.path).name}+{value - mapping.start + mapping.offset:#x}"
        return f"memory, {value % _ALIGNMENT} modulo {_ALIGNMENT}"


def fingerprint_of(thread: Tracee, process: Process, maps: MemoryMap) -> tuple[Fingerprint, Pointers]:
    """What a standing thread is about to do, in a form that is the same in every repetition of a flight.

    Registers that the instruction does not read may hold what is left of a clock's reading.

    :raises TargetError: if the thread has been killed, or there is no instruction.
    """
    registers, instruction = stand(thread, process)
    pointers = Pointers(maps, registers.stack_pointer)
    read = {
        one.register: registers.get(one.register)
        for one in sorted(instruction.candidates, key=lambda one: one.register)
        if one.role == "source" and one.register_class == "gpr"
    }
    relative = (f"{name}={pointers.target(value) or format(value, 'x')}" for name, value in read.items())
    found = Fingerprint(
        instruction.code.hex(), _hash(f"{name}={value:x}" for name, value in read.items()), _hash(relative)
    )
    return found, pointers


def _hash(told: Iterable[str]) -> str:
    return hashlib.blake2b(",".join(told).encode(), digest_size=8).hexdigest()
