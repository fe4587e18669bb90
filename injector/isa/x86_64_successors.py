"""Where an x86-64 thread goes from an instruction."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import iced_x86
from iced_x86 import FlowControl, Mnemonic

from injector.isa.instruction import DecodeError
from injector.isa.registers import Registers

_SYSTEM_CALLS = {Mnemonic.SYSCALL, Mnemonic.SYSENTER}
_FAR = {Mnemonic.RETF, Mnemonic.IRET, Mnemonic.IRETD, Mnemonic.IRETQ, Mnemonic.SYSRET, Mnemonic.SYSEXIT}
_UNKNOWN = {FlowControl.INTERRUPT, FlowControl.XBEGIN_XABORT_XEND}


class UnpredictableError(Exception):
    """Where the thread goes cannot be told beforehand."""


@lru_cache(4096)
def _decoded(code: bytes, address: int) -> iced_x86.Instruction:
    return iced_x86.Decoder(64, code, ip=address).decode()


def successors(
    code: bytes, address: int, registers: Registers, word: Callable[[int], int]
) -> tuple[int, ...]:
    """Where a thread may be after the instruction that ``code`` begins with: one place or two.

    ``word`` reads eight bytes of its memory as a number. A repeated instruction counts as one, with all its
    repetitions; none is itself among the places that come next, so none for one that jumps to itself.

    :raises DecodeError: if there is no instruction.
    :raises UnpredictableError: for far branches, interrupts and transactions.
    """
    instruction = _decoded(code, address)
    if instruction.is_invalid:
        message = f"no instruction at {address:#x}: {code.hex()}"
        raise DecodeError(message)
    flow, following = instruction.flow_control, address + instruction.len
    if flow == FlowControl.NEXT or instruction.mnemonic in _SYSTEM_CALLS:
        found: tuple[int, ...] = (following,)
    elif (
        instruction.mnemonic in _FAR or flow in _UNKNOWN or instruction.is_jmp_far or instruction.is_call_far
    ):
        message = f"{instruction} cannot be followed"
        raise UnpredictableError(message)
    elif flow in (FlowControl.UNCONDITIONAL_BRANCH, FlowControl.CALL):
        found = (instruction.near_branch_target,)
    elif flow == FlowControl.CONDITIONAL_BRANCH:
        found = (instruction.near_branch_target, following)
    elif flow == FlowControl.RETURN:
        found = (word(registers.get("rsp")),)
    elif flow in (FlowControl.INDIRECT_BRANCH, FlowControl.INDIRECT_CALL):
        found = (_indirect(instruction, registers, word),)
    else:  # it raises an exception
        found = ()
    return tuple(one for one in found if one != address)


def _indirect(instruction: iced_x86.Instruction, registers: Registers, word: Callable[[int], int]) -> int:
    if instruction.op0_kind == iced_x86.OpKind.REGISTER:
        return registers.get(_name(instruction.op0_register))
    if instruction.is_ip_rel_memory_operand:
        return word(instruction.ip_rel_memory_address)
    address = instruction.memory_displacement
    if instruction.memory_base:
        address += registers.get(_name(instruction.memory_base))
    if instruction.memory_index:
        address += registers.get(_name(instruction.memory_index)) * instruction.memory_index_scale
    if instruction.memory_segment in (iced_x86.Register.FS, iced_x86.Register.GS):
        address += registers.get(f"{_name(instruction.memory_segment)}_base")
    return word(address % 2**64)


@lru_cache(256)
def _name(register: int) -> str:
    return iced_x86.Formatter(iced_x86.FormatterSyntax.INTEL).format_register(register)  # type: ignore[arg-type]
