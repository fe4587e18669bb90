"""Code in a running program that counts down the passes through an instruction and traps at the last one.

A breakpoint of the processor costs some 5 us at each pass; this costs a few ns, so that a pass far into the
run is reached at nearly the program's own speed. A jump takes the place of the first instructions, which lie
elsewhere meanwhile; before the fault the program's code is as it was again.
"""

from __future__ import annotations

import struct
from collections.abc import Container
from dataclasses import dataclass

import iced_x86
from iced_x86 import FlowControl

from injector.block_profile.translation_memory import TranslationMemory
from injector.block_profile.x86_64_translator import (
    MOST_BYTES,
    TRAP,
    BlockWriter,
    TranslationError,
    block_of,
    flags_are_free_in,
    jump,
)
from injector.tracing.process import Process

_WORD = struct.Struct("<q")
_JUMP_BYTES = len(jump(0, 0))
_LOCK, _DECREMENT, _IF_LEFT = b"\xf0", b"\x48\xff\x0d", b"\x75"  # lock; dec qword [rip+d]; jnz
_KEEP = b"\x48\x8d\x64\x24\x80\x50\x9f\x0f\x90\xc0"  # lea rsp,[rsp-128]; push rax; lahf; seto al
_BACK = b"\x04\x7f\x9e\x58\x48\x8d\xa4\x24\x80\x00\x00\x00"  # add al,127; sahf; pop rax; lea rsp,[rsp+128]
_MOVABLE = frozenset(
    {
        FlowControl.NEXT,
        FlowControl.CONDITIONAL_BRANCH,
        FlowControl.UNCONDITIONAL_BRANCH,
        FlowControl.RETURN,
        FlowControl.INDIRECT_BRANCH,
    }
)


@dataclass(frozen=True, slots=True)
class Displaced:
    """The instructions whose place a jump takes; whether counting before them may change the flags."""

    instructions: tuple[iced_x86.Instruction, ...]
    offsets: tuple[int, ...]
    size: int
    flags_are_free: bool


def displaced(code: bytes, address: int, arrivals: Container[int]) -> Displaced | None:
    """What a jump at an address would take the place of; None if it cannot be put there.

    ``arrivals`` are the addresses at which the program arrives otherwise than from the instruction before.
    """
    try:
        block, offsets = block_of(code, address, ())
    except TranslationError:
        return None
    size = 0
    for number, one in enumerate(block):
        if one.flow_control not in _MOVABLE or one.is_jmp_far:
            return None
        size += one.len
        if size >= _JUMP_BYTES:
            if any(address + at in arrivals for at in range(1, size)):
                return None
            kept = tuple(block[: number + 1])
            return Displaced(kept, tuple(offsets[: number + 1]), size, flags_are_free_in(block))
    return None


class Countdown:
    """Traps the program at a pass through an address; to be closed when it has, or before a fault."""

    def __init__(self, process: Process, memory: TranslationMemory, address: int, passes: int) -> None:
        """Put the code into ``memory``: the ``passes``-th pass from now on is trapped before the instruction.

        :raises TranslationError: if it cannot be put there.
        """
        self._process, self.address = process, address
        code = process.read_memory(address, min(MOST_BYTES, _room(process, address)))
        taken = displaced(code, address, ())
        if taken is None:
            message = f"no jump can be put at {address:#x}"
            raise TranslationError(message)
        self._true = code[: taken.size]
        word = memory.words(1)
        process.write_memory(word, _WORD.pack(passes))
        written, self.trapped_at = _countdown(memory.here, word, code, taken)
        process.write_memory(memory.here, written)
        self._jump = jump(address, memory.here) + self._true[_JUMP_BYTES:]
        self.put()

    def put(self) -> None:
        """Put the jump in its place, from which on passes are counted."""
        self._process.write_memory(self.address, self._jump)

    def close(self, process: Process | None = None) -> None:
        """Have the program's own code again, or that of a process that it has forked."""
        (process or self._process).write_memory(self.address, self._true)

    def is_there(self) -> bool:
        """Whether the jump is in its place."""
        return self._process.read_memory(self.address, len(self._jump)) == self._jump


def _room(process: Process, address: int) -> int:
    mapping = process.maps().at(address)
    return mapping.end - address if mapping is not None else 0


def _countdown(at: int, word: int, code: bytes, taken: Displaced) -> tuple[bytes, int]:
    """The code, and where its thread stands behind the trap; registers, flags and stack are the program's."""
    out = BlockWriter(at)
    if not taken.flags_are_free:
        out.code += _KEEP
    out.referring(_LOCK + _DECREMENT, word)
    back = b"" if taken.flags_are_free else _BACK
    out.code += _IF_LEFT + bytes([len(back) + len(TRAP)]) + back + TRAP
    trapped_at = at + len(out.code)
    out.code += back
    begin = taken.instructions[0].ip
    for one, offset in zip(taken.instructions, taken.offsets, strict=True):
        raw = code[one.ip - begin :][: one.len]
        out.instruction(one, raw, offset, is_last=one is taken.instructions[-1])
    for exit_ in out.close():
        at_field = exit_.field - at
        out.code[at_field : at_field + 4] = exit_.leading_to(exit_.target)
    return bytes(out.code), trapped_at
