"""What an instruction accesses, whatever the architecture: registers, memory and how many bits of them.

:mod:`injector.isa.x86_64_decoder` and :mod:`injector.isa.aarch64_decoder` find it out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Role = Literal["source", "destination"]
RegisterClass = Literal["gpr", "vector", "flags", "mask"]
Operand = Literal["source", "destination", "any"]


class DecodeError(Exception):
    """The bytes are no instruction."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A register that an instruction accesses: its lowest ``width_bits`` bits.

    ``accessed`` are the numbers of the bits that it accesses, where that is not all of them: status flags.
    ``element_bits`` is the width of the floating-point numbers that it takes them for, 0 for none.
    """

    register: str
    role: Role
    width_bits: int
    register_class: RegisterClass
    element_bits: int = 0
    accessed: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class MemoryAccess:
    """Memory that an instruction reads or writes, ``width_bits`` from an address that registers give.

    The address is ``base + index * scale + displacement`` within ``address_bits``, plus ``segment``; a
    register that takes no part is empty. Registers count as they are before the instruction.
    """

    role: Role
    width_bits: int
    element_bits: int = 0
    base: str = ""
    index: str = ""
    scale: int = 1
    displacement: int = 0
    segment: str = ""
    address_bits: int = 64


@dataclass(frozen=True, slots=True)
class Instruction:
    """A decoded instruction; ``text`` is in Intel syntax on x86-64, in Arm's on AArch64.

    Not ``steppable``: a system call, which may never return, or one that would show the program that it
    is being stepped (``pushf`` stores the trap flag).
    """

    address: int
    code: bytes
    text: str
    steppable: bool
    candidates: tuple[Candidate, ...]
    memory: tuple[MemoryAccess, ...] = ()

    def eligible(self, operand: Operand, register_class: RegisterClass | Literal["any"]) -> list[Candidate]:
        """The candidates of a role and class. What is read and written counts once as each."""
        return [
            one
            for one in self.candidates
            if operand in ("any", one.role) and register_class in ("any", one.register_class)
        ]
