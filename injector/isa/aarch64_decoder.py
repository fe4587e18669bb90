"""Decoding AArch64 instructions with Capstone, whose account of accesses has holes that are mended here.

Capstone takes the first operand of a comparison for written, knows no register of ``ret``, and nothing of
what the atomic instructions of Armv8.1 transfer, of which only the address registers are offered.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from typing import Any

from injector.isa.aarch64_registers import FIELDS, STATUS_FLAGS
from injector.isa.instruction import Candidate, DecodeError, Instruction, MemoryAccess, Role

_COMPARISONS = frozenset({"cmp", "cmn", "tst", "ccmp", "ccmn", "fcmp", "fcmpe", "fccmp", "fccmpe"})
_EXTENSIONS = frozenset({"uxtb", "uxth", "uxtw", "sxtb", "sxth", "sxtw"})
_SYSTEM_CALLS = frozenset({"svc", "hvc", "smc"})
_CALLS = frozenset({"bl", "blr"})
_LENGTH = 4
_LOAD_STORE = re.compile(r"(ld|st)(?:u|t)?(r|p)(s?[bhw])?")
_TRANSFER_BITS = {"b": 8, "h": 16, "w": 32}
"""What a suffix of a load or store says of the width in memory; else it is the register's."""

_WIDTHS = {"xzr": 64, "wzr": 32} | {name: field.width for name, field in FIELDS.items()}
_TO_FLOAT = frozenset({"scvtf", "ucvtf"})
_FROM_FLOAT = re.compile(r"fcvt[anmpzt]+[su]|fjcvtzs")
_FLOATING = re.compile(r"f(?!mov)\w+")


_ARRANGEMENT = re.compile(r"v\d+\.(\d*)([bhsdq])")
_ELEMENTS = {"b": 8, "h": 16, "s": 32, "d": 64, "q": 128}


@cache
def _disassembler() -> Any:
    """Imported here: x86-64 does without."""
    capstone = import_module("capstone")
    disassembler = capstone.Cs(capstone.CS_ARCH_ARM64, capstone.CS_MODE_ARM)
    disassembler.detail = True
    return disassembler


def decode(code: bytes, address: int) -> Instruction:
    """Decode the A64 instruction that ``code`` begins with.

    Candidates are general and SIMD registers, implicit ones and ``sp`` included, and the flags together
    as ``nzcv``; the zero register is none. Memory is what plain loads and stores transfer, of pairs too.

    :raises DecodeError: if it begins with no whole instruction.
    """
    found = next(_disassembler().disasm(code[:_LENGTH], address, 1), None)
    if found is None:
        message = f"no instruction at {address:#x}: {code.hex()}"
        raise DecodeError(message)
    return Instruction(
        address,
        code[:_LENGTH],
        f"{found.mnemonic} {found.op_str}".rstrip(),
        found.mnemonic not in _SYSTEM_CALLS,
        tuple(dict.fromkeys(_candidates(found))),
        tuple(_memory(found)),
    )


def _candidates(found: Any) -> Iterator[Candidate]:
    for name, role in _accesses(found):
        if name == "nzcv":
            yield Candidate(name, role, 32, "flags", accessed=STATUS_FLAGS)
        elif name in FIELDS and FIELDS[name].vector:
            element, width = _arrangement(found.op_str, name)
            floating = element in (32, 64) and _floating(found.mnemonic, role)
            yield Candidate(name, role, width, "vector", element if floating else 0)
        elif name in FIELDS:
            yield Candidate(name, role, FIELDS[name].width, "gpr")


def _accesses(found: Any) -> Iterator[tuple[str, Role]]:
    read, written = (list(map(found.reg_name, one)) for one in found.regs_access())
    mnemonic = found.mnemonic
    first = found.reg_name(found.operands[0].reg) if found.operands and found.operands[0].reg else ""
    if mnemonic in _COMPARISONS:
        read, written = [first, *read], ["nzcv"]
    elif mnemonic in _EXTENSIONS:
        read = [found.reg_name(found.operands[1].reg)]
    elif mnemonic == "ret":
        read = [first or "lr"]
    elif mnemonic in _CALLS:
        written = ["lr"]
    elif mnemonic in _SYSTEM_CALLS:
        written = []
    for name in read:
        yield name, "source"
    for name in written:
        yield name, "destination"


def _arrangement(operands: str, name: str) -> tuple[int, int]:
    """Bits of an element and of the whole, as the text shows them (``v1.4s``); a scalar is one element."""
    for shown in _ARRANGEMENT.finditer(operands):
        if shown[0].startswith(f"{name}."):
            element = _ELEMENTS[shown[2]]
            return element, element * int(shown[1] or 1)
    return FIELDS[name].width, FIELDS[name].width


def _floating(mnemonic: str, role: Role) -> bool:
    """Whether an instruction takes its vector operands of a role for floating-point numbers."""
    if mnemonic in _TO_FLOAT:
        return role == "destination"
    if _FROM_FLOAT.fullmatch(mnemonic):
        return role == "source"
    return _FLOATING.fullmatch(mnemonic) is not None


def _memory(found: Any) -> Iterator[MemoryAccess]:
    plain = _LOAD_STORE.fullmatch(found.mnemonic)
    arm64 = import_module("capstone").arm64
    operand = next((one for one in found.operands if one.type == arm64.ARM64_OP_MEM), None)
    # Of the extensions of an index, only that which leaves it as it is.
    if plain is None or operand is None or operand.ext not in (arm64.ARM64_EXT_INVALID, arm64.ARM64_EXT_UXTW):
        return
    width = _TRANSFER_BITS.get((plain[3] or " ")[-1]) or _WIDTHS.get(found.reg_name(found.operands[0].reg), 0)
    if not width:  # a register of SVE
        return
    index = found.reg_name(operand.mem.index)
    yield MemoryAccess(
        "source" if plain[1] == "ld" else "destination",
        2 * width if plain[2] == "p" else width,
        base=found.reg_name(operand.mem.base),
        index=index if index in FIELDS else "",  # not the zero register
        scale=1 << operand.shift.value,
        displacement=operand.mem.disp,
    )
