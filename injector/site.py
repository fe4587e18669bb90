"""What tells a dynamic instruction from others: its bytes, and what it finds in its registers."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from injector.freeze import Thread
from injector.inject import stand
from injector.process import Maps, Process


@dataclass(frozen=True, slots=True)
class Seen:
    """The bytes of the next instruction, and a hash of the registers that it reads, both hexadecimal."""

    code: str
    registers: str


def look(thread: Thread, process: Process, maps: Maps) -> Seen:
    """What a standing thread is about to do, in a form that is the same in every repetition of a flight.

    Of a register that holds an address only that is hashed: other threads' allocations move addresses.
    Registers that the instruction does not read may hold what is left of a clock's reading.

    :raises TargetError: if the thread has been killed, or there is no instruction.
    """
    registers, instruction = stand(thread, process)
    read = sorted(
        (one.register, one.width_bits)
        for one in instruction.candidates
        if one.role == "source" and one.register_class == "gpr"
    )
    found = [(name, registers.get(name), width) for name, width in read]
    text = ",".join(
        f"{name}={'address' if holds_address(maps, value, width) else f'{value:x}'}"
        for name, value, width in found
    )
    return Seen(instruction.code.hex(), hashlib.blake2b(text.encode(), digest_size=8).hexdigest())


def holds_address(maps: Maps, value: int, width_bits: int) -> bool:
    """Whether a value is an address of the process's memory, or the lower half of one, or two are in it."""
    if width_bits == 32:
        return any(maps.at(upper << 32 | value) is not None for upper in maps.upper_halves())
    words = (value >> shift & 2**64 - 1 for shift in range(0, width_bits, 64))
    return any(maps.at(word) is not None for word in words)
