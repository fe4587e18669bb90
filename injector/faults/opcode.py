"""Corrupt the bytes of an instruction for one execution: a fault of the control logic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from injector.isa.host import decode
from injector.isa.instruction import DecodeError, Instruction
from injector.tracing.process import LONGEST_INSTRUCTION, AddressError, Process
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.models.faults.arithmetic import draw_bits, groups
from services.models.faults.specification import FaultSpec

DRAWS = 100
"""Draws that turn an instruction into a system call before it is passed over."""

NO_INSTRUCTION = "(no instruction)"


@dataclass(frozen=True, slots=True)
class CorruptedOpcode:
    """An instruction with bits inverted, and what a processor takes the bytes for."""

    bits: tuple[int, ...]
    code: bytes
    text: str


def corrupt(
    instruction: Instruction, process: Process, fault: FaultSpec, draw: np.random.Generator
) -> CorruptedOpcode | None:
    """Draw the bits of an instruction to invert; None if there is no choice.

    Bit i is bit i % 8 of byte i // 8. What would make a system call of it (or an instruction that shows
    the program that it is stepped) is drawn again: the call would ask the kernel for something arbitrary,
    and may never return. With another model nothing is inverted.
    """
    code = process.read_code(instruction.address)
    size = len(instruction.code)
    among = groups(fault, 8 * size)
    for _ in range(DRAWS if among else 0):
        bits = draw_bits(fault, among, draw)
        changed = inverted(code[:size], bits if fault.model == "opcode" else ())
        try:
            # It may have become longer and swallow what follows.
            after = decode((changed + code[size:])[:LONGEST_INSTRUCTION], instruction.address)
        except DecodeError:
            return CorruptedOpcode(bits, changed, NO_INSTRUCTION)
        if after.steppable:
            return CorruptedOpcode(bits, changed, after.text)
    return None


def inverted(code: bytes, bits: Sequence[int]) -> bytes:
    """``code`` with these bits inverted."""
    value = int.from_bytes(code, "little")
    for bit in bits:
        value ^= 1 << bit
    return value.to_bytes(len(code), "little")


def execute(
    tracees: TraceeGroup,
    thread: Tracee,
    process: Process,
    instruction: Instruction,
    corrupted: CorruptedOpcode,
) -> tuple[bytes, str]:
    """Let a standing thread execute the corrupted bytes once, and put the true ones back whatever comes.

    All other threads must stand. The bytes as they were read back, and what went wrong with the thread:
    nothing, or a signal, of which it hears when it goes on.

    :raises AddressError: if the code cannot be changed, or not be restored.
    """
    mapping = process.maps().at(instruction.address)
    if mapping is None or mapping.permissions[3] != "p":
        message = f"the code at {instruction.address:#x} is shared with other processes"
        raise AddressError(message)
    end = ""
    with process.changed_code(instruction.address, corrupted.code, instruction.code) as read_back:
        if read_back == corrupted.code:
            end = tracees.step(thread)
    if end == "faulted":
        return read_back, f"it raised signal {thread.signals[-1]}"
    return read_back, {"gone": "the thread was killed in it", "stuck": "it did not end"}.get(end, "")
