"""Translation of a block of any program's code, which sees its own return addresses and can have threads.

Unlike :mod:`injector.block_profile.x86_64_translator`, on which it stands, it leaves the program's code as
it is. So nobody arrives at a translation unled: who returns, calls or jumps by a register or memory, is
led on by a table in the process (:class:`LeadTable`), which the injector fills. Unwinders, and code that
reads itself, find what they would find without us.

Registers are kept, while the table is looked at, in memory of the thread that its ``gs`` register leads to;
no program of x86-64 Linux uses that register by itself. Sources: Intel SDM volume 2; System V ABI, 3.4.
"""

from __future__ import annotations

import struct
from collections.abc import Container
from dataclasses import dataclass

import iced_x86
from iced_x86 import Code, FlowControl, MemoryOperand, OpKind, Register

from injector.block_profile.x86_64_translator import (
    JUMP,
    TRAP,
    BlockWriter,
    Exit,
    TranslationError,
    block_of,
    displacement,
    flags_are_free_in,
)

THREAD_BYTES = 64
"""Memory of each thread behind ``gs``, in which its registers are kept."""

SLOTS = 1 << 16
"""Entries of each way of the table that leads to translations; an address's lowest 16 bits are the index."""

WAYS = 4
"""Addresses with the same index that find room."""

TABLE_BYTES = 8 * SLOTS
"""Size of the true addresses of a way, and of their translations."""

KEPT = {"rax": 0, "rcx": 8, "rdx": 16}
"""Where in a thread's memory the registers are at a miss."""

TARGET_AT = 24
"""Where in it the true address is then."""

_ABSOLUTE = struct.Struct("<I")
_ADDRESS = struct.Struct("<Q")
_SIGNED = struct.Struct("<i")

_INCREMENT, _DECREMENT = b"\x48\xff\x05", b"\x48\xff\x0d"  # inc qword [rip+d], dec
_IF_LEFT = b"\x75"  # jnz
_FLAGS_TO_AH, _OVERFLOW_TO_AL = b"\x9f", b"\x0f\x90\xc0"  # lahf; seto al
_OVERFLOW_FROM_AL, _FLAGS_FROM_AH = b"\x04\x7f", b"\x9e"  # add al,127; sahf
_PUSH, _UPPER_HALF = b"\x68", b"\xc7\x44\x24\x04"  # push imm32; mov dword [rsp+4],imm32
_POP_RCX, _RAISE_STACK = b"\x59", b"\x48\x8d\xa4\x24"  # pop rcx; lea rsp,[rsp+imm32]
_INDEX = b"\x0f\xb7\xc1"  # movzx eax,cx
_RDX_IS = b"\x48\xba"  # mov rdx,imm64
_TAG, _DIFFERENCE = b"\x48\x8b\x14\xc2", b"\x48\x8d\x0c\x11"  # mov rdx,[rdx+rax*8]; lea rcx,[rcx+rdx]
_AT_ZERO, _SHORT = b"\xe3", b"\xeb"  # jrcxz, jmp
_DESTINATION = b"\x48\x8b\x04\xc2"  # mov rax,[rdx+rax*8]
_INDIRECT = (FlowControl.INDIRECT_BRANCH, FlowControl.INDIRECT_CALL)
_LEADS_ON = (FlowControl.NEXT, FlowControl.CALL, FlowControl.INTERRUPT)
_UNKNOWN = (FlowControl.XBEGIN_XABORT_XEND,)


def _gs(opcode: bytes, at: int) -> bytes:
    """An instruction with a memory operand in the thread's own memory; ``opcode`` without ModRM's address."""
    return b"\x65" + opcode + b"\x25" + _ABSOLUTE.pack(at)


_KEEP_RAX, _RAX_BACK = _gs(b"\x48\x89\x04", KEPT["rax"]), _gs(b"\x48\x8b\x04", KEPT["rax"])
_KEEP_RCX, _RCX_BACK = _gs(b"\x48\x89\x0c", KEPT["rcx"]), _gs(b"\x48\x8b\x0c", KEPT["rcx"])
_KEEP_RDX, _RDX_BACK = _gs(b"\x48\x89\x14", KEPT["rdx"]), _gs(b"\x48\x8b\x14", KEPT["rdx"])
_KEEP_TARGET, _GO_TO_TARGET = _gs(b"\x48\x89\x04", TARGET_AT), _gs(b"\xff\x24", TARGET_AT)
_KEEP_RCX_AS_TARGET = _gs(b"\x48\x89\x0c", TARGET_AT)
_RCX_IS_TARGET = _gs(b"\x48\x8b\x0c", TARGET_AT)


@dataclass(frozen=True, slots=True)
class LeadTable:
    """The table in a process, at ``begin``: of each way negated true addresses, then their translations.

    An entry is never replaced: another thread might be between the two.
    """

    begin: int

    def code(self) -> tuple[bytes, int]:
        """The code that leads on who has the true address in rcx, and where in it one misses: behind a trap.

        Its own rcx is in the thread's memory; at a miss so are rax, rdx and the address. Flags are kept.
        """
        find, leads = _KEEP_RAX + _KEEP_RDX + _KEEP_RCX_AS_TARGET + _INDEX, b""
        tries, hits = [], []
        for way in range(WAYS):
            again = _RCX_IS_TARGET if way else b""
            tries.append(again + _RDX_IS + _ADDRESS.pack(self._tags(way)) + _TAG + _DIFFERENCE)
            hits.append(_RDX_IS + _ADDRESS.pack(self._tags(way) + TABLE_BYTES))
        # After each try a jump to its hit, which ends with a jump to the common end.
        common = _DESTINATION + _KEEP_TARGET + _RAX_BACK + _RCX_BACK + _RDX_BACK + _GO_TO_TARGET
        skip = len(_SHORT) + 1
        for one, hit in zip(tries, hits, strict=True):
            here = hit + JUMP + bytes(_SIGNED.size)
            leads += one + _AT_ZERO + bytes([skip]) + _SHORT + bytes([len(here)]) + here
        found = find + leads
        miss = len(found) + len(TRAP)
        code = bytearray(found + TRAP + common)
        at = len(find)
        for one, hit in zip(tries, hits, strict=True):
            at += len(one) + len(_AT_ZERO) + 1 + skip + len(hit) + len(JUMP) + _SIGNED.size
            code[at - _SIGNED.size : at] = _SIGNED.pack(miss - at)
        return bytes(code), miss

    def entry(self, address: int, translation: int, way: int) -> tuple[tuple[int, bytes], tuple[int, bytes]]:
        """What is to be written where, in order, so that an address leads to its translation."""
        at = self._tags(way) + address % SLOTS * _ADDRESS.size
        tag = _ADDRESS.pack(-address % 2**64)
        return (at + TABLE_BYTES, _ADDRESS.pack(translation)), (at, tag)

    def _tags(self, way: int) -> int:
        return self.begin + 2 * way * TABLE_BYTES


@dataclass(frozen=True, slots=True)
class ProgramBlock:
    """A translated block: the addresses of its ``instructions``, its ``code`` and the ways out of it.

    ``clean`` are the offsets in the code at which nothing of ours is under way, one for each instruction.
    ``after_call`` is the offset behind a system call or trap at its end, 0 if there is none; ``stop`` that
    behind the trap of a countdown.
    """

    instructions: tuple[int, ...]
    code: bytes
    exits: tuple[Exit, ...]
    clean: tuple[int, ...]
    after_call: int
    stop: int


def translate_program(
    code: bytes,
    address: int,
    at: int,
    passes: int,
    lead: int,
    leaders: Container[int] = (),
    remaining: int = 0,
) -> ProgramBlock:
    """Translate the block that begins with ``code`` at ``address`` for memory ``at`` another address.

    It counts in the word at ``passes`` and goes on by the table's code at ``lead``. It ends before each of
    ``leaders`` at the latest. The word at ``remaining`` becomes one less at each pass: at zero it traps.

    :raises TranslationError: if it begins with no instruction, is too far away or is a transaction.
    """
    block, offsets = block_of(code, address, leaders)
    out = _ProgramWriter(at, lead)
    if remaining:
        out.count_down(remaining)
    out.count_pass(passes, flags_are_free=flags_are_free_in(block))
    clean = []
    for one, offset in zip(block, offsets, strict=True):
        clean.append(len(out.code))
        out.program_instruction(one, code[one.ip - address :][: one.len], offset, is_last=one is block[-1])
    exits = out.close()
    addresses = tuple(one.ip for one in block)
    return ProgramBlock(addresses, bytes(out.code), exits, tuple(clean), out.after_call, out.stop)


class _ProgramWriter(BlockWriter):
    """Writes a block whose calls leave true return addresses."""

    def __init__(self, at: int, lead: int) -> None:
        super().__init__(at)
        self._lead = lead
        self.after_call = 0

    def count_pass(self, passes: int, *, flags_are_free: bool) -> None:
        """Count by one instruction: a thread that is interrupted loses no pass."""
        if flags_are_free:
            self.referring(_INCREMENT, passes)
            return
        self.code += _KEEP_RAX + _FLAGS_TO_AH + _OVERFLOW_TO_AL
        self.referring(_INCREMENT, passes)
        self.code += _OVERFLOW_FROM_AL + _FLAGS_FROM_AH + _RAX_BACK

    def count_down(self, remaining: int) -> None:
        """Count down, and trap at the last pass, with registers and flags as they are."""
        self.code += _KEEP_RAX + _FLAGS_TO_AH + _OVERFLOW_TO_AL
        self.referring(_DECREMENT, remaining)
        back = _OVERFLOW_FROM_AL + _FLAGS_FROM_AH + _RAX_BACK
        self.code += _IF_LEFT + bytes([len(back) + len(TRAP)]) + back + TRAP
        self.stop = len(self.code)
        self.code += back

    def program_instruction(
        self, one: iced_x86.Instruction, raw: bytes, offset: int, *, is_last: bool
    ) -> None:
        """Write one instruction; the last one with the ways out of it."""
        flow = one.flow_control
        uses_gs = one.segment_prefix == Register.GS
        if uses_gs or flow in _UNKNOWN or one.is_jmp_far or one.is_call_far:
            what = "uses register gs" if uses_gs else "cannot be followed"
            message = f"code at {one.ip:#x} {what} ({one})"
            raise TranslationError(message)
        if flow == FlowControl.CALL and one.near_branch_target:
            self._push(one.next_ip)
            self.way_out(JUMP, one.near_branch_target)
        elif flow in _INDIRECT:
            self.code += _KEEP_RCX
            self._load_rcx(one)
            if flow == FlowControl.INDIRECT_CALL:
                self._push(one.next_ip)
            self._lead_on()
        elif flow == FlowControl.RETURN:
            self.code += _KEEP_RCX + _POP_RCX
            if one.op_count:
                self.code += _RAISE_STACK + _ABSOLUTE.pack(one.immediate(0))
            self._lead_on()
        else:
            self.instruction(one, raw, offset, is_last=is_last and flow not in _LEADS_ON)
            if flow in (FlowControl.CALL, FlowControl.INTERRUPT):
                self.after_call = len(self.code)
            if is_last and flow in _LEADS_ON:
                self.way_out(JUMP, one.next_ip)

    def _push(self, address: int) -> None:
        low = address & 0xFFFF_FFFF
        self.code += _PUSH + _ABSOLUTE.pack(low)
        signed = _SIGNED.unpack(_ABSOLUTE.pack(low))[0]
        if signed % 2**64 != address:
            self.code += _UPPER_HALF + _ABSOLUTE.pack(address >> 32)

    def _lead_on(self) -> None:
        after = self.at + len(self.code) + len(JUMP) + _SIGNED.size
        self.code += JUMP + displacement(self._lead, after)

    def _load_rcx(self, one: iced_x86.Instruction) -> None:
        """``mov rcx`` from the operand of an indirect call or jump."""
        if one.op0_kind == OpKind.REGISTER:
            load = iced_x86.Instruction.create_reg_reg(Code.MOV_R64_RM64, Register.RCX, one.op0_register)
        else:
            operand = MemoryOperand(
                one.memory_base,
                one.memory_index,
                one.memory_index_scale,
                one.memory_displacement
                if one.memory_displacement < 2**63
                else one.memory_displacement - 2**64,
                one.memory_displ_size,
                False,
                one.segment_prefix,
            )
            load = iced_x86.Instruction.create_reg_mem(Code.MOV_R64_RM64, Register.RCX, operand)
        encoder = iced_x86.Encoder(64)
        try:
            encoder.encode(load, self.at + len(self.code))
        except ValueError as error:
            raise TranslationError(str(error)) from error
        self.code += encoder.take_buffer()
