"""Decoding x86-64 instructions with iced-x86, which knows every access, implicit ones included."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import iced_x86
from iced_x86 import (
    CodeSize,
    Formatter,
    FormatterSyntax,
    MemorySize,
    MemorySizeExt,
    Mnemonic,
    OpAccess,
    OpKind,
    RegisterExt,
    RflagsBits,
)

from injector.isa.instruction import Candidate, DecodeError, Instruction, MemoryAccess, Role

if TYPE_CHECKING:
    from iced_x86._iced_x86_py import Register  # the type; iced_x86.Register is a module of constants

_READS = {OpAccess.READ, OpAccess.COND_READ, OpAccess.READ_WRITE, OpAccess.READ_COND_WRITE}
_WRITES = {OpAccess.WRITE, OpAccess.COND_WRITE, OpAccess.READ_WRITE, OpAccess.READ_COND_WRITE}
_SURE = {OpAccess.READ, OpAccess.WRITE, OpAccess.READ_WRITE}
_SYSTEM_CALLS = {Mnemonic.SYSCALL, Mnemonic.SYSENTER, Mnemonic.INT}
_PUSH_FLAGS = {Mnemonic.PUSHF, Mnemonic.PUSHFD, Mnemonic.PUSHFQ}
_CLEAR_VECTORS = {Mnemonic.VZEROUPPER, Mnemonic.VZEROALL}
_LARGEST_WORD = 64
"""Bytes; what is larger is a saved state and no operand."""

_STATUS = {
    RflagsBits.CF: 0,
    RflagsBits.PF: 2,
    RflagsBits.AF: 4,
    RflagsBits.ZF: 6,
    RflagsBits.SF: 7,
    RflagsBits.DF: 10,
    RflagsBits.OF: 11,
}
"""The bit of rflags that each status flag of iced stands for."""

_ELEMENT_BITS = {"SS": 32, "SD": 64, "PS": 32, "PD": 64}
_FLOATS = {MemorySize.FLOAT32: 32, MemorySize.FLOAT64: 64}
_FLOATING = re.compile(r"(?!V?(?:P|4F|BROADCAST|GATHER|SCATTER|MASKMOV))\w+([SP][SD])")
_PACKED_MOVE = re.compile(r"V?MOV(?!MSK)\w*P[SD]|V?MOV(HL|LH)PS")
_CONVERSION = re.compile(r"V?CVTT?(\w+)2(\w+)")
_MASK_INSTRUCTION = re.compile(r"K[A-Z]+([BWDQ])|VPBROADCASTM([BW])2[QD]")
_MASK_CONVERSION = re.compile(r"VPMOVM2([BWDQ])|VPMOV([BWDQ])2M")
_MASK_BITS = {"B": 8, "W": 16, "D": 32, "Q": 64}
_NAMES = {number: name for name, number in vars(Mnemonic).items() if name.isupper()}

MNEMONICS = frozenset(name.lower() for name in _NAMES.values()) - {"invalid"}
"""Of all instructions, as people write them."""


def mnemonic(instruction: iced_x86.Instruction) -> str:
    """The mnemonic of an instruction, one of :data:`MNEMONICS`."""
    return _NAMES[instruction.mnemonic].lower()


def decode(code: bytes, address: int) -> Instruction:
    """Decode the 64-bit instruction that ``code`` begins with.

    Candidates are all general, vector and mask registers, implicit ones and ``rsp`` included, and the
    status flags together as ``rflags``; ``rip``, segment, x87 and MMX registers are none. Memory is what
    the instruction accesses for certain and as one word of at most 64 bytes.

    :raises DecodeError: if it begins with no whole instruction.
    """
    instruction = iced_x86.Decoder(64, code, ip=address).decode()
    if instruction.is_invalid:
        message = f"no instruction at {address:#x}: {code.hex()}"
        raise DecodeError(message)
    info = iced_x86.InstructionInfoFactory().info(instruction)
    return Instruction(
        address,
        code[: instruction.len],
        Formatter(FormatterSyntax.INTEL).format(instruction),
        instruction.mnemonic not in _SYSTEM_CALLS | _PUSH_FLAGS,
        tuple(dict.fromkeys([*_registers(instruction, info), *_flags(instruction)])),
        tuple(_memory(instruction, info)),
    )


def _registers(instruction: iced_x86.Instruction, info: iced_x86.InstructionInfo) -> Iterator[Candidate]:
    # These name no register, and clear sixteen.
    if instruction.mnemonic in _CLEAR_VECTORS:
        return
    for used in info.used_registers():
        if used.access in _READS:
            yield from _candidate(instruction, used.register, "source")
        if used.access in _WRITES:
            yield from _candidate(instruction, _written(instruction, info, used.register), "destination")


def _candidate(instruction: iced_x86.Instruction, register: Register, role: Role) -> Iterator[Candidate]:
    name = _name(register)
    width = 8 * RegisterExt.size(register)
    if RegisterExt.is_gpr(register):
        yield Candidate(name, role, width, "gpr")
    elif RegisterExt.is_vector_register(register):
        element, scalar = _element(instruction.mnemonic, role)
        if scalar and RegisterExt.is_xmm(register):
            width = element
        yield Candidate(name, role, width, "vector", element)
    elif RegisterExt.is_k(register):
        yield Candidate(name, role, _mask_bits(instruction), "mask")


def first_input(instruction: iced_x86.Instruction) -> Candidate | None:
    """The first register that an instruction names as an operand and reads: of ``mulsd xmm0,xmm1`` xmm0."""
    info = iced_x86.InstructionInfoFactory().info(instruction)
    for operand in range(instruction.op_count):
        if instruction.op_kind(operand) == OpKind.REGISTER and info.op_access(operand) in _READS:
            return next(_candidate(instruction, instruction.op_register(operand), "source"), None)
    return None


def _name(register: Register) -> str:
    return Formatter(FormatterSyntax.INTEL).format_register(register)


def _written(
    instruction: iced_x86.Instruction, info: iced_x86.InstructionInfo, register: Register
) -> Register:
    """The register as the instruction names it: iced counts bits that are cleared beyond it as written."""
    if not (RegisterExt.is_gpr64(register) or RegisterExt.is_zmm(register)):
        return register
    for operand in range(instruction.op_count):
        named = instruction.op_register(operand)
        if info.op_access(operand) in _WRITES and RegisterExt.full_register(named) == register:
            return named
    # Implicit: `mul ecx`, `cdq`, `cpuid` write edx; what keeps rcx, rsi, rdi and rsp going writes them whole.
    read_too = any(used.register == register and used.access in _READS for used in info.used_registers())
    if RegisterExt.is_gpr64(register) and instruction.op_code().operand_size != 64 and not read_too:
        return RegisterExt.full_register32(register)
    return register


def _element(mnemonic: int, role: Role) -> tuple[int, bool]:
    """How wide the floating-point numbers are that an instruction takes a vector for; whether it is one only.

    0: it takes it for something else. So does a move of a whole vector, which compilers use for any data.
    What else happens to the register of a scalar (the rest is kept, copied or cleared) is no access.
    """
    name = _NAMES[mnemonic]
    conversion = _CONVERSION.fullmatch(name)
    if conversion:
        kind = conversion[1 if role == "source" else 2]
    else:
        floating = None if _PACKED_MOVE.fullmatch(name) else _FLOATING.fullmatch(name)
        kind = floating[1] if floating else ""
    return _ELEMENT_BITS.get(kind, 0), kind in ("SS", "SD")


def _mask_bits(instruction: iced_x86.Instruction) -> int:
    """How many bits of a mask register count: one a lane, or as many as its instruction's name says."""
    name = _NAMES[instruction.mnemonic]
    if named := _MASK_INSTRUCTION.fullmatch(name):
        return _MASK_BITS[next(filter(None, named.groups()))]
    element = MemorySizeExt.element_size(instruction.op_code().memory_size)
    if converted := _MASK_CONVERSION.fullmatch(name):
        element = _MASK_BITS[next(filter(None, converted.groups()))] // 8
    widest = max(
        (
            RegisterExt.size(instruction.op_register(operand))
            for operand in range(instruction.op_count)
            if RegisterExt.is_vector_register(instruction.op_register(operand))
        ),
        default=0,
    )
    return widest // element if element and widest >= element else 64


def _flags(instruction: iced_x86.Instruction) -> Iterator[Candidate]:
    """What is left undefined counts as not written: no program reads it."""
    written = instruction.rflags_written | instruction.rflags_cleared | instruction.rflags_set
    both: tuple[tuple[Role, int], ...] = (("source", instruction.rflags_read), ("destination", written))
    for role, used in both:
        accessed = tuple(bit for flag, bit in _STATUS.items() if used & flag)
        if accessed:
            yield Candidate("rflags", role, 64, "flags", accessed=accessed)


def _memory(instruction: iced_x86.Instruction, info: iced_x86.InstructionInfo) -> Iterator[MemoryAccess]:
    for used in info.used_memory():
        size = MemorySizeExt.size(used.memory_size)
        if used.access not in _SURE or used.vsib_size or not 0 < size <= _LARGEST_WORD:
            continue
        segment = _name(used.segment) if used.segment else ""
        moved = _PACKED_MOVE.fullmatch(_NAMES[instruction.mnemonic])
        element = 0 if moved else _FLOATS.get(MemorySizeExt.element_type(used.memory_size), 0)
        for role, roles in (("source", _READS), ("destination", _WRITES)):
            if used.access in roles:
                yield MemoryAccess(
                    role,  # type: ignore[arg-type]
                    8 * size,
                    element,
                    _name(used.base) if used.base else "",
                    _name(used.index) if used.index else "",
                    used.scale,
                    used.displacement,
                    f"{segment}_base" if segment in ("fs", "gs") else "",
                    32 if used.address_size == CodeSize.CODE32 else 64,
                )
