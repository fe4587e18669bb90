"""Translation of one basic block of x86-64 code into code elsewhere that does the same and counts itself.

A block begins where the program arrives and ends with the first instruction that may go on elsewhere. Its
translation leaves registers, flags and stack as the block does, but for the return addresses on the stack:
they lie in the translation of what follows a call. An exception of C++ finds no way through such a frame.

Sources: Intel SDM volume 2 (encodings); System V ABI, 3.2.2 (the red zone, why nothing is pushed).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from typing import Protocol

import iced_x86
from iced_x86 import ConditionCode, FlowControl, Mnemonic, Register, RflagsBits

LONGEST = 64
"""Instructions after which a block is divided."""

MOST_BYTES = 15 * LONGEST
"""Bytes of code that a block may need."""

TRAP = b"\xcc"
"""An instruction that raises SIGTRAP."""

_INCREMENT = b"\x48\xff\x05"  # inc qword [rip+d]
_STORE_RAX, _LOAD_RAX = b"\x48\x89\x05", b"\x48\x8b\x05"  # mov [rip+d],rax and back
_LOAD_RAX_FAR = b"\x48\xa1"  # mov rax,[address]
_LOAD_BY_RAX = b"\x48\x8b\x00"  # mov rax,[rax]
_RAX_PLUS_ONE = b"\x48\x8d\x40\x01"  # lea rax,[rax+1]
_STORE_RCX, _LOAD_RCX = b"\x48\x89\x0d", b"\x48\x8b\x0d"
_RCX_LESS_ONE = b"\x48\x8d\x49\xff"  # lea rcx,[rcx-1]
_TRAP_AT_ZERO = b"\xe3\x02\xeb\x01" + TRAP  # jrcxz to the trap, jmp over it
JUMP, _CALL, _JUMP_IF, _CONDITION = b"\xe9", b"\xe8", 0x0F, 0x80
_OVER_A_JUMP = 5
_DISPLACEMENT = struct.Struct("<i")
_ADDRESS = struct.Struct("<Q")

_CHANGED_BY_INCREMENT = int(RflagsBits.OF | RflagsBits.SF | RflagsBits.ZF | RflagsBits.AF | RflagsBits.PF)
_CL = int(Register.CL)
_SHORT_ONLY = frozenset({Mnemonic.LOOP, Mnemonic.LOOPE, Mnemonic.LOOPNE, Mnemonic.JRCXZ, Mnemonic.JECXZ})
_LEADS_ON = frozenset({FlowControl.NEXT, FlowControl.CALL, FlowControl.INDIRECT_CALL})


class TranslationError(Exception):
    """There is no instruction to translate, or its translation lies too far from what it refers to."""


@dataclass(frozen=True, slots=True)
class Counters:
    """Addresses of the words in which a block's translation counts; each 0 if it is to be left out.

    ``passes`` counts the passes through the block. At each, ``noted`` gets the present value of the word
    whose address ``watched`` holds, and ``remaining`` becomes one less: at zero the translation traps, at the
    block's beginning. ``scratch`` are two words to keep registers in.
    """

    passes: int
    scratch: int
    noted: int = 0
    watched: int = 0
    remaining: int = 0


@dataclass(frozen=True, slots=True)
class Exit:
    """A way out of a translation: a displacement at ``field``, which leads to a ``trap`` until it is set."""

    field: int
    trap: int
    target: int

    def leading_to(self, address: int) -> bytes:
        """What is to be written at ``field``."""
        return displacement(address, self.field + _DISPLACEMENT.size)


class InsertedCode(Protocol):
    """Machine code around an instruction's translation; it spares whatever it is not to change.

    No code is put behind an instruction that may lead elsewhere.
    """

    def before(self, at: int) -> bytes:
        """The code to lie ``at`` this address, the instruction right behind it."""

    def after(self, at: int) -> bytes:
        """The code to lie ``at`` this address, right behind the instruction."""


Insert = Callable[[iced_x86.Instruction, bytes], InsertedCode | None]
"""What is put around an instruction of these bytes, if anything."""


@dataclass(frozen=True, slots=True)
class Translation:
    """The translation of the block whose ``instructions`` lie at these addresses; ``size`` are its bytes.

    ``returns`` are pairs: a return address that the translation leaves on the stack, and the true one.
    ``stop`` is what the program counter is at the trap of ``Counters.remaining``. A jump may be written over
    the block's beginning only if it ``takes_a_jump``: nobody arrives within those five bytes.
    """

    instructions: tuple[int, ...]
    size: int
    code: bytes
    exits: tuple[Exit, ...]
    returns: tuple[tuple[int, int], ...]
    stop: int
    takes_a_jump: bool


def jump(at: int, target: int) -> bytes:
    """A jump to ``target``, to lie ``at``."""
    return JUMP + displacement(target, at + len(JUMP) + _DISPLACEMENT.size)


def translate(
    code: bytes,
    address: int,
    at: int,
    counters: Counters | None,
    leaders: Container[int] = (),
    insert: Insert = lambda _instruction, _code: None,
) -> Translation:
    """Translate the block that begins with ``code`` at ``address`` for memory ``at`` another address.

    It ends before each of ``leaders`` at the latest. Without ``counters`` it counts nothing.

    :raises TranslationError: if it begins with no instruction, or lies too far away.
    """
    block, offsets = block_of(code, address, leaders)
    out = BlockWriter(at)
    if counters is not None:
        out.count(counters, flags_are_free=flags_are_free_in(block))
    for one, offset in zip(block, offsets, strict=True):
        raw = code[one.ip - address :][: one.len]
        out.instruction(one, raw, offset, is_last=one is block[-1], around=insert(one, raw))
    exits = out.close()
    return Translation(
        tuple(one.ip for one in block),
        block[-1].next_ip - address,
        bytes(out.code),
        exits,
        tuple(out.returns),
        out.stop,
        _takes_a_jump(code, address),
    )


def _takes_a_jump(code: bytes, address: int) -> bool:
    """Whether a jump may be written over the code at an address where somebody arrives.

    Functions begin at multiples of 16 or with a mark for indirect calls. That leaders divide the code there
    does not matter: to them the translation leads.
    """
    whole, _ = block_of(code, address, ())
    begins = address % 16 == 0 or whole[0].mnemonic == Mnemonic.ENDBR64
    length = len(jump(0, 0))
    return whole[-1].next_ip - address >= length and (whole[0].len >= length or begins)


def block_of(
    code: bytes, address: int, leaders: Container[int]
) -> tuple[list[iced_x86.Instruction], list[int]]:
    """A block's instructions, and where in each the displacement of its memory operand is."""
    decoder = iced_x86.Decoder(64, code, ip=address)
    block: list[iced_x86.Instruction] = []
    offsets = []
    for one in decoder:
        if one.is_invalid or (block and one.ip in leaders):
            break
        block.append(one)
        offsets.append(decoder.get_constant_offsets(one).displacement_offset)
        # In a call of the kernel, too: a signal may end it there.
        if one.flow_control != FlowControl.NEXT or len(block) == LONGEST:
            break
    if not block:
        message = f"no instruction at {address:#x}"
        raise TranslationError(message)
    return block, offsets


def flags_are_free_in(block: Sequence[iced_x86.Instruction]) -> bool:
    """Whether the block sets all flags that counting would change before it reads one of them.

    Shifts by a register and repeated instructions may leave them as they are.
    """
    settled = 0
    for one in block:
        if one.rflags_read & _CHANGED_BY_INCREMENT & ~settled:
            return False
        by_register = _CL in (int(one.op1_register), int(one.op2_register))
        if not (one.is_string_instruction or by_register):
            settled |= one.rflags_modified
        if settled & _CHANGED_BY_INCREMENT == _CHANGED_BY_INCREMENT:
            return True
    return False


def displacement(target: int, after: int) -> bytes:
    """The displacement of an instruction that ends at ``after``.

    :raises TranslationError: if the target is too far away.
    """
    try:
        return _DISPLACEMENT.pack(target - after)
    except struct.error as error:
        message = f"{target:#x} is too far from {after:#x} for a displacement"
        raise TranslationError(message) from error


class BlockWriter:
    """Code that is written one instruction after the other, for one address."""

    def __init__(self, at: int) -> None:
        self.code = bytearray()
        self.stop = 0
        self.returns: list[tuple[int, int]] = []
        self.at = at
        self._open: list[tuple[int, int]] = []

    def count(self, counters: Counters, *, flags_are_free: bool) -> None:
        """Count a pass, and do what else is asked for."""
        if flags_are_free and not counters.noted and not counters.remaining:
            self.referring(_INCREMENT, counters.passes)
            return
        self.referring(_STORE_RAX, counters.scratch)
        self.referring(_LOAD_RAX, counters.passes)
        self.code += _RAX_PLUS_ONE
        self.referring(_STORE_RAX, counters.passes)
        if counters.noted:
            self.code += _LOAD_RAX_FAR + _ADDRESS.pack(counters.watched) + _LOAD_BY_RAX
            self.referring(_STORE_RAX, counters.noted)
        self.referring(_LOAD_RAX, counters.scratch)
        if counters.remaining:
            kept = counters.scratch + _ADDRESS.size
            self.referring(_STORE_RCX, kept)
            self.referring(_LOAD_RCX, counters.remaining)
            self.code += _RCX_LESS_ONE
            self.referring(_STORE_RCX, counters.remaining)
            self.code += _TRAP_AT_ZERO
            self.stop = self.at + len(self.code)
            self.referring(_LOAD_RCX, kept)

    def instruction(
        self,
        one: iced_x86.Instruction,
        raw: bytes,
        offset: int,
        *,
        is_last: bool,
        around: InsertedCode | None = None,
    ) -> None:
        """Write one instruction of the block; the last one with the ways out of it."""
        flow = one.flow_control
        if around is not None:
            self.code += around.before(self.at + len(self.code))
        if flow == FlowControl.CONDITIONAL_BRANCH and one.mnemonic in _SHORT_ONLY:
            self.code += raw[:-1] + bytes([_OVER_A_JUMP])
            self.way_out(JUMP, one.next_ip)
            self.way_out(JUMP, one.near_branch_target)
        elif flow == FlowControl.CONDITIONAL_BRANCH:
            condition = _CONDITION + one.condition_code - ConditionCode.O
            self.way_out(bytes([_JUMP_IF, condition]), one.near_branch_target)
            self.way_out(JUMP, one.next_ip)
        elif flow == FlowControl.UNCONDITIONAL_BRANCH and one.near_branch_target:
            self.way_out(JUMP, one.near_branch_target)
        elif flow == FlowControl.CALL and one.near_branch_target:
            self.way_out(_CALL, one.near_branch_target)
            self.returns.append((self.at + len(self.code), one.next_ip))
            self.way_out(JUMP, one.next_ip)
        else:
            if one.is_ip_rel_memory_operand:
                after = self.at + len(self.code) + one.len
                moved = displacement(one.ip_rel_memory_address, after)
                raw = raw[:offset] + moved + raw[offset + len(moved) :]
            self.code += raw
            if around is not None and flow == FlowControl.NEXT:
                self.code += around.after(self.at + len(self.code))
            if flow == FlowControl.INDIRECT_CALL:
                self.returns.append((self.at + len(self.code), one.next_ip))
            if is_last and flow in _LEADS_ON:
                self.way_out(JUMP, one.next_ip)

    def close(self) -> tuple[Exit, ...]:
        """Write the traps to which the ways out lead."""
        exits = []
        for field, target in self._open:
            trap = self.at + len(self.code)
            self.code += TRAP
            exits.append(Exit(self.at + field, trap, target))
            self.code[field : field + _DISPLACEMENT.size] = exits[-1].leading_to(trap)
        return tuple(exits)

    def way_out(self, opcode: bytes, target: int) -> None:
        """Write a jump or call that leads out of the block."""
        self.code += opcode
        self._open.append((len(self.code), target))
        self.code += bytes(_DISPLACEMENT.size)

    def referring(self, opcode: bytes, to: int) -> None:
        """Write an instruction whose operand is the memory at an address."""
        after = self.at + len(self.code) + len(opcode) + _DISPLACEMENT.size
        self.code += opcode + displacement(to, after)
