"""What a fault may strike: operands of an instruction that are of the kind it asks for."""

from __future__ import annotations

from collections.abc import Sequence

from injector.isa.host import named
from injector.isa.instruction import Candidate, Instruction, MemoryAccess
from services.models.faults.arithmetic import groups
from services.models.faults.specification import FaultSpec

Bits = list[Sequence[int]]
"""The sets of bits of which one is drawn, see :func:`services.models.faults.arithmetic.groups`."""


def eligible_registers(fault: FaultSpec, instruction: Instruction) -> list[tuple[Candidate, Bits]]:
    """The registers of an instruction that the fault may change, each with the bits to draw from."""
    return [
        (one, among)
        for one in _registers(fault, instruction)
        if (among := groups(fault, one.width_bits, one.element_bits, one.accessed))
    ]


def _registers(fault: FaultSpec, instruction: Instruction) -> list[Candidate]:
    if fault.registers is None:
        return instruction.eligible(fault.operand, fault.register_class)
    return [one for one in map(named, fault.registers) if one is not None]


def eligible_memory(fault: FaultSpec, instruction: Instruction) -> list[tuple[MemoryAccess, Bits]]:
    """The memory of an instruction that the fault may change, each word with the bits to draw from."""
    return [
        (one, among)
        for one in instruction.memory
        if fault.operand in ("any", one.role) and (among := groups(fault, one.width_bits, one.element_bits))
    ]


def is_eligible(fault: FaultSpec, instruction: Instruction) -> bool:
    """Whether the fault can strike an instruction, by what it reads and writes. No system call can be."""
    if not instruction.steppable:
        return False
    if fault.model == "opcode":
        return bool(groups(fault, 8 * len(instruction.code)))
    if fault.model == "memory":
        return bool(eligible_memory(fault, instruction))
    return bool(eligible_registers(fault, instruction))
