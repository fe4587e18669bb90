"""The registers of an x86-64 thread: general ones with their parts, status flags, vectors and masks.

Source: Linux arch/x86/include/asm/user_64.h (struct user_regs_struct).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from injector.isa import x86_64_xstate
from injector.isa.instruction import Candidate, RegisterClass
from injector.isa.registers import Registers, UnknownRegisterError
from injector.tracing.ptrace import NT_PRSTATUS, NT_X86_XSTATE, PtraceError, read_registers, write_registers

_ORDER = (
    *("r15", "r14", "r13", "r12", "rbp", "rbx", "r11", "r10", "r9", "r8"),
    *("rax", "rcx", "rdx", "rsi", "rdi", "orig_rax", "rip", "cs", "eflags", "rsp", "ss"),
    *("fs_base", "gs_base", "ds", "es", "fs", "gs"),
)
_OFFSETS = {name: 8 * index for index, name in enumerate(_ORDER)}
_SIZE = 8 * len(_ORDER)
_RESTARTS = (-512, -513, -514, -516)
"""What the kernel leaves in rax of a system call that it will enter again (linux/errno.h)."""

NO_SYSTEM_CALL = 2**64 - 1

_SYSTEM_CALL_SIZE = 2
"""Bytes of the instruction."""


@dataclass(frozen=True, slots=True)
class RegisterPart:
    """A general register or a part of one: ``width`` bits from bit ``shift`` of ``whole``."""

    whole: str
    shift: int
    width: int


def _parts() -> dict[str, RegisterPart]:
    parts = {}
    for letter in "abcd":
        whole = f"r{letter}x"
        parts[f"e{letter}x"] = RegisterPart(whole, 0, 32)
        parts[f"{letter}x"] = RegisterPart(whole, 0, 16)
        parts[f"{letter}l"] = RegisterPart(whole, 0, 8)
        parts[f"{letter}h"] = RegisterPart(whole, 8, 8)
    for name in ("si", "di", "bp", "sp"):
        whole = f"r{name}"
        parts[f"e{name}"] = RegisterPart(whole, 0, 32)
        parts[name] = RegisterPart(whole, 0, 16)
        parts[f"{name}l"] = RegisterPart(whole, 0, 8)
    for number in range(8, 16):
        whole = f"r{number}"
        parts |= {
            f"{whole}{suffix}": RegisterPart(whole, 0, width)
            for suffix, width in (("d", 32), ("w", 16), ("b", 8))
        }
    wholes = sorted({part.whole for part in parts.values()})
    return parts | {whole: RegisterPart(whole, 0, 64) for whole in wholes}


GENERAL = _parts()
"""Every general register and part by name."""

VECTOR = {
    f"{kind}mm{number}": (number, size)
    for kind, size in (("x", 16), ("y", 32), ("z", 64))
    for number in range(32)
}
"""Number and size in bytes of every vector register by name; a machine may have fewer."""

MASK = {f"k{number}": number for number in range(8)}
"""Number of every mask register by name; a machine may have none."""

STATUS_FLAGS = (0, 2, 4, 6, 7, 10, 11)
"""The bits of rflags that are offered: CF, PF, AF, ZF, SF, DF and OF. The others are not the program's."""

_STATUS = sum(1 << bit for bit in STATUS_FLAGS)
_WHOLE = ("fs_base", "gs_base", "rip")


def register_classes(enabled: int | None = None) -> frozenset[RegisterClass]:
    """The classes that a processor has; by default this one, else one with these state components."""
    components = x86_64_xstate.enabled() if enabled is None else enabled
    classes: set[RegisterClass] = {"gpr", "vector", "flags"}
    return frozenset(classes | {"mask"} if components >> x86_64_xstate.OPMASK & 1 else classes)


def named(name: str, enabled: int | None = None) -> Candidate | None:
    """A register by its name, as something to strike; None if there is none here.

    ``enabled`` are state components of the processor, by default of this one.
    """
    if name in GENERAL or name == "rip":
        return Candidate(name, "source", GENERAL[name].width if name in GENERAL else 64, "gpr")
    if name == "rflags":
        return Candidate(name, "source", 64, "flags", accessed=STATUS_FLAGS)
    if name not in VECTOR and name not in MASK:
        return None
    components = x86_64_xstate.enabled() if enabled is None else enabled
    pieces = x86_64_xstate.pieces(*VECTOR[name]) if name in VECTOR else [x86_64_xstate.mask_piece(MASK[name])]
    if not all(components >> piece.component & 1 for piece in pieces):
        return None
    is_vector = name in VECTOR
    return Candidate(
        name, "source", 8 * VECTOR[name][1] if is_vector else 64, "vector" if is_vector else "mask"
    )


def entering(general: bytearray, instruction: int, number: int, *arguments: int) -> bytearray:
    """General registers that enter a system call at a ``syscall`` ``instruction`` (System V ABI, A.2.1)."""
    changed = bytearray(general)
    order = ("rdi", "rsi", "rdx", "r10", "r8", "r9")
    values = {"rip": instruction, "rax": number, **dict(zip(order, arguments, strict=False))}
    for name, value in values.items():
        struct.pack_into("<Q", changed, _OFFSETS[name], value)
    return outside_of_calls(changed)


def skipping_call(general: bytearray, result: int) -> bytearray:
    """General registers of a thread that stands before a system call, which is not made but answered so."""
    changed = outside_of_calls(general)
    struct.pack_into("<Q", changed, _OFFSETS["rax"], result)
    return changed


def outside_of_calls(general: bytearray) -> bytearray:
    """General registers of a thread that the kernel has no system call to enter again for."""
    changed = bytearray(general)
    struct.pack_into("<Q", changed, _OFFSETS["orig_rax"], NO_SYSTEM_CALL)
    return changed


def entering_again(general: bytearray) -> bytearray:
    """General registers of a thread that stands before the system call that the kernel would enter again.

    Those of a thread that is in none are left as they are, but for what says so.
    """
    changed = outside_of_calls(general)
    (number,) = struct.unpack_from("<q", general, _OFFSETS["orig_rax"])
    (result,) = struct.unpack_from("<q", general, _OFFSETS["rax"])
    if number >= 0 and result in _RESTARTS:
        (after,) = struct.unpack_from("<Q", general, _OFFSETS["rip"])
        struct.pack_into("<Q", changed, _OFFSETS["rip"], after - _SYSTEM_CALL_SIZE)
        struct.pack_into("<q", changed, _OFFSETS["rax"], number)
    return changed


class X8664Registers(Registers):
    """The registers of a standing x86-64 thread."""

    def __init__(self, tid: int) -> None:
        """Read the registers of a standing thread.

        :raises PtraceError: if the thread runs 32-bit code.
        """
        self._tid = tid
        self._general = read_registers(tid, NT_PRSTATUS, _SIZE)
        if len(self._general) != _SIZE:
            message = f"thread {tid} belongs to a 32-bit process; only 64-bit ones can be injected into"
            raise PtraceError(message)
        (result,) = struct.unpack_from("<q", self._general, _OFFSETS["rax"])
        self._in_system_call = self._word("orig_rax") < 2**63 and result in _RESTARTS
        self._extended: bytearray | None = None
        self._general_changed = self._extended_changed = False

    def _word(self, name: str) -> int:
        return int(struct.unpack_from("<Q", self._general, _OFFSETS[name])[0])

    @property
    def program_counter(self) -> int:
        """Address of the instruction that comes next."""
        return self._word("rip")

    @property
    def stack_pointer(self) -> int:
        """Address of the top of the thread's stack."""
        return self.get("rsp")

    @property
    def in_system_call(self) -> bool:
        """Whether the thread was stopped within a system call that is to be entered again."""
        return self._in_system_call

    def get(self, name: str) -> int:
        """The value of a register, by its name."""
        part = GENERAL.get(name)
        if part is not None:
            return self._word(part.whole) >> part.shift & (1 << part.width) - 1
        if name == "rflags":
            return self._word("eflags") & _STATUS
        if name in _WHOLE:
            return self._word(name)
        state = self._state()
        content = b"".join(state[piece.offset : piece.offset + piece.size] for piece in self._pieces(name))
        return int.from_bytes(content, "little")

    def put(self, name: str, value: int) -> None:
        """Change a register and nothing else."""
        if name in _WHOLE:
            struct.pack_into("<Q", self._general, _OFFSETS[name], value)
            self._general_changed = True
            return
        part = RegisterPart("eflags", 0, 64) if name == "rflags" else GENERAL.get(name)
        if part is not None:
            field = _STATUS if name == "rflags" else (1 << part.width) - 1 << part.shift
            word = self._word(part.whole) & ~field | value << part.shift & field
            struct.pack_into("<Q", self._general, _OFFSETS[part.whole], word)
            self._general_changed = True
            return
        state = self._state()
        pieces = self._pieces(name)
        content = value.to_bytes(sum(piece.size for piece in pieces), "little")
        for piece in pieces:
            state[piece.offset : piece.offset + piece.size] = content[: piece.size]
            content = content[piece.size :]
            # A component that is not marked as in use would be reset by the kernel.
            state[x86_64_xstate.XSTATE_BV_AT] |= 1 << piece.component
        self._extended_changed = True

    def commit(self) -> None:
        """Write the changes to the thread."""
        if self._general_changed:
            if not self._in_system_call:
                # The kernel must not take a flipped rax for a request to enter a system call again.
                struct.pack_into("<Q", self._general, _OFFSETS["orig_rax"], NO_SYSTEM_CALL)
            write_registers(self._tid, NT_PRSTATUS, self._general)
        if self._extended_changed:
            write_registers(self._tid, NT_X86_XSTATE, self._state())
        self._general_changed = self._extended_changed = False

    def _state(self) -> bytearray:
        if self._extended is None:
            self._extended = read_registers(self._tid, NT_X86_XSTATE, x86_64_xstate.LARGEST)
        return self._extended

    def _pieces(self, name: str) -> list[x86_64_xstate.StateComponent]:
        if name in VECTOR or name in MASK:
            state = self._state()
            enabled = int.from_bytes(state[x86_64_xstate.ENABLED_AT : x86_64_xstate.ENABLED_AT + 8], "little")
            wanted = list(
                x86_64_xstate.pieces(*VECTOR[name])
                if name in VECTOR
                else [x86_64_xstate.mask_piece(MASK[name])]
            )
            if all(enabled >> piece.component & 1 for piece in wanted):
                return wanted
        message = f"thread {self._tid} has no register {name!r}"
        raise UnknownRegisterError(message)
