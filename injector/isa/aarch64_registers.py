"""The registers of an AArch64 thread: x0-x30, sp and pc, status flags, and v0-v31 with their parts.

Tested on register images only; it has not run on such a machine yet.
Source: Linux arch/arm64/include/uapi/asm/ptrace.h (struct user_pt_regs, struct user_fpsimd_state).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from injector.isa.instruction import Candidate, RegisterClass
from injector.isa.registers import Registers, UnknownRegisterError
from injector.tracing.ptrace import NT_PRSTATUS, PtraceError, read_registers, write_registers

REGISTER_CLASSES: frozenset[RegisterClass] = frozenset({"gpr", "vector", "flags"})
"""Predicates of SVE are not offered, so there is no class ``mask``."""

STATUS_FLAGS = (28, 29, 30, 31)
"""The bits of pstate that are offered: V, C, Z and N."""

NT_PRFPREG = 2
_GENERAL_SIZE, _VECTOR_SIZE = 272, 528
_PC_AT, _PSTATE_AT, _STACK = 256, 264, 31
_NUMBERED = {f"x{number}": number for number in range(31)} | {"fp": 29, "lr": 30, "sp": _STACK}
_WIDTHS = {"b": 8, "h": 16, "s": 32, "d": 64, "q": 128, "v": 128}


@dataclass(frozen=True, slots=True)
class RegisterField:
    """``width`` bits from bit ``shift`` of what begins at byte ``offset`` of a register set."""

    vector: bool
    offset: int
    width: int
    shift: int = 0


def _fields() -> dict[str, RegisterField]:
    fields = {
        name: RegisterField(vector=False, offset=8 * number, width=64) for name, number in _NUMBERED.items()
    }
    for number in range(31):
        fields[f"w{number}"] = RegisterField(vector=False, offset=8 * number, width=32)
    fields["pc"] = RegisterField(vector=False, offset=_PC_AT, width=64)
    fields["wsp"] = RegisterField(vector=False, offset=8 * _STACK, width=32)
    fields["nzcv"] = RegisterField(vector=False, offset=_PSTATE_AT, width=4, shift=STATUS_FLAGS[0])
    for letter, width in _WIDTHS.items():
        for number in range(32):
            fields[f"{letter}{number}"] = RegisterField(vector=True, offset=16 * number, width=width)
    return fields


FIELDS = _fields()
"""Every register and part by name."""


def named(name: str) -> Candidate | None:
    """A register by its name, as something to strike; None if there is none."""
    field = FIELDS.get(name)
    if field is None:
        return None
    if name == "nzcv":
        return Candidate(name, "source", 64, "flags", accessed=STATUS_FLAGS)
    return Candidate(name, "source", field.width, "vector" if field.vector else "gpr")


class AArch64Registers(Registers):
    """The registers of a standing AArch64 thread."""

    def __init__(
        self,
        tid: int,
        read: Callable[[int, int, int], bytearray] = read_registers,
        write: Callable[[int, int, bytearray], None] = write_registers,
    ) -> None:
        """Read them, as ptrace does or from elsewhere.

        :raises PtraceError: if the thread runs 32-bit code.
        """
        self._tid, self._read, self._write = tid, read, write
        self._general = read(tid, NT_PRSTATUS, _GENERAL_SIZE)
        if len(self._general) != _GENERAL_SIZE:
            message = f"thread {tid} belongs to a 32-bit process; only 64-bit ones can be injected into"
            raise PtraceError(message)
        self._vector: bytearray | None = None
        self._changed: set[int] = set()

    @property
    def program_counter(self) -> int:
        """Address of the instruction that comes next."""
        return int(struct.unpack_from("<Q", self._general, _PC_AT)[0])

    @property
    def stack_pointer(self) -> int:
        """Address of the top of the thread's stack."""
        return self.get("sp")

    @property
    def in_system_call(self) -> bool:
        """Never: this kernel puts a thread that it will have enter a call again back to the call first.

        The thread then stands at ``svc``, which is not stepped (Linux arch/arm64/kernel/signal.c).
        """
        return False

    def get(self, name: str) -> int:
        """The value of a register; flags at their places in pstate."""
        field = self._field(name)
        value = self._whole(field) >> field.shift & (1 << field.width) - 1
        return value << field.shift

    def put(self, name: str, value: int) -> None:
        """Change a register and nothing else."""
        field = self._field(name)
        mask = (1 << field.width) - 1 << field.shift
        whole = self._whole(field) & ~mask | value & mask
        size = 16 if field.vector else 8
        self._set(field)[field.offset : field.offset + size] = whole.to_bytes(size, "little")
        self._changed.add(NT_PRFPREG if field.vector else NT_PRSTATUS)

    def commit(self) -> None:
        """Write the changes to the thread."""
        for kind in sorted(self._changed):
            self._write(self._tid, kind, self._general if kind == NT_PRSTATUS else self._vectors())
        self._changed.clear()

    def _field(self, name: str) -> RegisterField:
        try:
            return FIELDS[name]
        except KeyError:
            message = f"thread {self._tid} has no register {name!r}"
            raise UnknownRegisterError(message) from None

    def _set(self, field: RegisterField) -> bytearray:
        return self._vectors() if field.vector else self._general

    def _whole(self, field: RegisterField) -> int:
        size = 16 if field.vector else 8
        return int.from_bytes(self._set(field)[field.offset : field.offset + size], "little")

    def _vectors(self) -> bytearray:
        if self._vector is None:
            self._vector = self._read(self._tid, NT_PRFPREG, _VECTOR_SIZE)
        return self._vector
