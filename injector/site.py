"""What tells a dynamic instruction from others: its bytes, and what is in the registers."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from injector.freeze import Thread
from injector.inject import registers_of, stand
from injector.process import Maps, Process

_GENERAL = (
    *("rax", "rcx", "rdx", "rbx", "rsp", "rbp", "rsi", "rdi"),
    *(f"r{number}" for number in range(8, 16)),
)


@dataclass(frozen=True, slots=True)
class Seen:
    """The bytes of the next instruction, and a hash of the general registers, both hexadecimal."""

    code: str
    registers: str


def look(thread: Thread, process: Process, maps: Maps) -> Seen:
    """What a standing thread is about to do, in a form that is the same in every repetition of a flight.

    Of a register that holds an address only that is hashed: other threads' allocations move addresses.

    :raises TargetError: if the thread has been killed, or there is no instruction.
    """
    _, instruction = stand(thread, process)
    registers = registers_of(thread)
    values = {name: registers.get(name) for name in _GENERAL}
    text = ",".join("address" if maps.at(value) is not None else f"{value:x}" for value in values.values())
    return Seen(instruction.code.hex(), hashlib.blake2b(text.encode(), digest_size=8).hexdigest())


def holds_address(maps: Maps, value: int, width_bits: int) -> bool:
    """Whether a value is an address of the process's memory, or the lower half of one, or two are in it."""
    if width_bits == 32:
        return any(maps.at(upper << 32 | value) is not None for upper in maps.upper_halves())
    words = (value >> shift & 2**64 - 1 for shift in range(0, width_bits, 64))
    return any(maps.at(word) is not None for word in words)
