"""The architecture that we run on: its registers, its instructions, and what this processor has of them."""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache

from injector.isa import aarch64_decoder, aarch64_registers, x86_64_decoder, x86_64_registers
from injector.isa.instruction import Candidate, Instruction, RegisterClass
from injector.isa.registers import Registers
from services.models.faults.arithmetic import groups
from services.models.faults.specification import FaultSpec


@dataclass(frozen=True, slots=True)
class Architecture:
    """What the injector needs to know of one.

    ``registers`` are those of a standing thread by its tid, ``decode`` takes bytes and their address,
    ``named`` finds a register to strike by its name, None if there is none; ``classes`` are the classes of
    registers of this very processor, ``flags`` the bits of status flags,
    ``mnemonics`` those of instructions among which a fault may recur: none if it cannot.
    """

    registers: Callable[[int], Registers]
    decode: Callable[[bytes, int], Instruction]
    named: Callable[[str], Candidate | None]
    classes: Callable[[], frozenset[RegisterClass]]
    flags: tuple[int, ...]
    mnemonics: frozenset[str]


_ARCHITECTURES = {
    "x86_64": Architecture(
        x86_64_registers.X8664Registers,
        x86_64_decoder.decode,
        x86_64_registers.named,
        x86_64_registers.register_classes,
        x86_64_registers.STATUS_FLAGS,
        x86_64_decoder.MNEMONICS,
    ),
    "aarch64": Architecture(
        aarch64_registers.AArch64Registers,
        aarch64_decoder.decode,
        aarch64_registers.named,
        lambda: aarch64_registers.REGISTER_CLASSES,
        aarch64_registers.STATUS_FLAGS,
        frozenset(),
    ),
}
HOST = _ARCHITECTURES.get(platform.machine(), _ARCHITECTURES["x86_64"])

decode = lru_cache(4096)(HOST.decode)
"""Decoding on this machine; what is stepped through repeats."""

named = lru_cache(256)(HOST.named)
"""A register of this machine by its name, as something to strike; None if there is none."""


class AbsentError(ValueError):
    """The processor does not have the registers that a fault is to corrupt: one line."""


def require(fault: FaultSpec, host: Architecture = HOST) -> None:
    """Refuse a fault that this processor has no register for.

    :raises AbsentError: naming what is absent.
    """
    _require_opcodes(fault, host)
    _require_registers(fault, host)
    wanted = fault.register_class
    present = host.classes()
    if wanted != "any" and wanted not in present:
        message = f"register class {wanted} absent on this CPU: choose of {', '.join(sorted(present))}"
        raise AbsentError(message)
    given = "bits" if fault.histogram is None else "histogram"
    if wanted == "flags" and fault.most_bits > len(host.flags):
        message = f"{given}: there are {len(host.flags)} status flags on this CPU, not {fault.most_bits}"
        raise AbsentError(message)
    unknown = fault.named_bits - set(host.flags)
    if wanted == "flags" and unknown:
        flags = ", ".join(map(str, host.flags))
        given = "bit_numbers" if fault.histogram is None else "histogram"
        message = f"{given}: bit {min(unknown)} is no status flag on this CPU: choose of {flags}"
        raise AbsentError(message)


def _require_registers(fault: FaultSpec, host: Architecture) -> None:
    for name in fault.registers or ():
        register = host.named(name)
        if register is None:
            message = f"registers: there is no {name!r} on this CPU; expected names like those in disassembly"
            raise AbsentError(message)
        if not groups(fault, register.width_bits, 0, register.accessed):
            message = f"registers: {name} has not the bits that are asked for"
            raise AbsentError(message)


def _require_opcodes(fault: FaultSpec, host: Architecture) -> None:
    if fault.recurs_in_instructions and not host.mnemonics:
        raise AbsentError(f"recurrence {fault.recurrence} at level instruction is not there on this CPU")
    for name in fault.opcodes or ():
        if name not in host.mnemonics:
            similar = ", ".join(get_close_matches(name, sorted(host.mnemonics), 3))
            message = f"opcodes: there is no instruction {name!r} on this CPU; similar: {similar or 'none'}"
            raise AbsentError(message)
