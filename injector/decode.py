"""Which registers an instruction reads and writes, and how many bits of them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import iced_x86
from iced_x86 import Formatter, FormatterSyntax, Mnemonic, OpAccess, RegisterExt

if TYPE_CHECKING:
    from iced_x86._iced_x86_py import Register  # the type; iced_x86.Register is a module of constants

Role = Literal["source", "destination"]
RegisterClass = Literal["gpr", "vector"]

_READS = {OpAccess.READ, OpAccess.COND_READ, OpAccess.READ_WRITE, OpAccess.READ_COND_WRITE}
_WRITES = {OpAccess.WRITE, OpAccess.COND_WRITE, OpAccess.READ_WRITE, OpAccess.READ_COND_WRITE}
_SYSTEM_CALLS = {Mnemonic.SYSCALL, Mnemonic.SYSENTER, Mnemonic.INT}
_PUSH_FLAGS = {Mnemonic.PUSHF, Mnemonic.PUSHFD, Mnemonic.PUSHFQ}
_CLEAR_VECTORS = {Mnemonic.VZEROUPPER, Mnemonic.VZEROALL}
_ELEMENT_BITS = {"SS": 32, "SD": 64}
_SCALAR = re.compile(r"(?!V?(?:P|4F|BROADCAST))\w+(S[SD])")
_CONVERSION = re.compile(r"V?CVTT?(\w+)2(\w+)")


class DecodeError(Exception):
    """The bytes are no instruction."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A register that an instruction accesses: its lowest ``width_bits`` bits."""

    register: str
    role: Role
    width_bits: int
    register_class: RegisterClass


@dataclass(frozen=True, slots=True)
class Instruction:
    """A decoded instruction; ``text`` is in Intel syntax.

    Not ``steppable``: a system call, which may never return, or one that would show the program that it
    is being stepped (``pushf`` stores the trap flag).
    """

    address: int
    code: bytes
    text: str
    steppable: bool
    candidates: tuple[Candidate, ...]

    def eligible(
        self, operand: Literal["source", "destination", "any"], register_class: RegisterClass | Literal["any"]
    ) -> list[Candidate]:
        """The candidates of a role and class. What is read and written counts once as each."""
        return [
            one
            for one in self.candidates
            if operand in ("any", one.role) and register_class in ("any", one.register_class)
        ]


def decode(code: bytes, address: int) -> Instruction:
    """Decode the 64-bit instruction that ``code`` begins with.

    Candidates are all general and vector registers, implicit ones and ``rsp`` included; ``rip``, flags,
    segment, mask, x87 and MMX registers are none.

    :raises DecodeError: if it begins with no whole instruction.
    """
    instruction = iced_x86.Decoder(64, code, ip=address).decode()
    if instruction.is_invalid:
        message = f"no instruction at {address:#x}: {code.hex()}"
        raise DecodeError(message)
    return Instruction(
        address,
        code[: instruction.len],
        Formatter(FormatterSyntax.INTEL).format(instruction),
        instruction.mnemonic not in _SYSTEM_CALLS | _PUSH_FLAGS,
        tuple(dict.fromkeys(_candidates(instruction))),
    )


def _candidates(instruction: iced_x86.Instruction) -> Iterator[Candidate]:
    # These name no register, and clear sixteen.
    if instruction.mnemonic in _CLEAR_VECTORS:
        return
    info = iced_x86.InstructionInfoFactory().info(instruction)
    for used in info.used_registers():
        if used.access in _READS:
            yield from _candidate(instruction, used.register, "source")
        if used.access in _WRITES:
            yield from _candidate(instruction, _written(instruction, info, used.register), "destination")


def _candidate(instruction: iced_x86.Instruction, register: Register, role: Role) -> Iterator[Candidate]:
    name = Formatter(FormatterSyntax.INTEL).format_register(register)
    width = 8 * RegisterExt.size(register)
    if RegisterExt.is_gpr(register):
        yield Candidate(name, role, width, "gpr")
    elif RegisterExt.is_vector_register(register):
        bits = _element_bits(instruction.mnemonic, role) if RegisterExt.is_xmm(register) else None
        yield Candidate(name, role, bits or width, "vector")


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


def _element_bits(mnemonic: int, role: Role) -> int | None:
    """The width of a scalar floating-point instruction's element; None for every other instruction.

    What else happens to the register (the rest is kept, copied or cleared) is not counted as access.
    """
    name = _NAMES[mnemonic]
    conversion = _CONVERSION.fullmatch(name)
    if conversion:
        return _ELEMENT_BITS.get(conversion[1 if role == "source" else 2])
    scalar = _SCALAR.fullmatch(name)
    return _ELEMENT_BITS[scalar[1]] if scalar else None


_NAMES = {number: name for name, number in vars(Mnemonic).items() if name.isupper()}
