"""Code in a running program that counts down the passes through an instruction and traps at the last one.

A breakpoint of the processor costs some 5 us at each pass; this costs a few ns, so that a pass far into the
run is reached at nearly the program's own speed. A jump takes the place of the first instructions, which lie
elsewhere meanwhile; before the fault the program's code is as it was again.

Where the program arrives within the five bytes of such a jump, a short one of two leads to bytes nearby that
the run does not execute, and there is the other.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container
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

JUMP_BYTES = len(jump(0, 0))
"""Bytes of a jump to anywhere within 2 GB."""

SHORT_JUMP_BYTES = 2
"""Bytes of a jump to what is less than 128 bytes away."""

_WORD, _NEAR = struct.Struct("<q"), struct.Struct("<b")
_SHORT = b"\xeb"
_DECREMENT, _IF_LEFT = b"\x48\xff\x0d", b"\x75"  # dec qword [rip+d]; jnz
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
    flags_are_free: bool


def displaced(code: bytes, address: int, arrivals: Container[int], jump_bytes: int) -> Displaced | None:
    """What a jump at an address would take the place of; None if it cannot be put there.

    ``arrivals`` are the addresses at which the program arrives otherwise than from the instruction before.
    """
    try:
        block, offsets = block_of(code, address, ())
    except TranslationError:
        return None
    kept = tuple(one for one in block if one.ip < address + jump_bytes)
    end = max(kept[-1].next_ip, address + jump_bytes)
    if any(one.flow_control not in _MOVABLE or one.is_jmp_far for one in kept):
        return None
    if any(at in arrivals for at in range(address + 1, end)):
        return None
    return Displaced(kept, tuple(offsets[: len(kept)]), flags_are_free_in(block))


class Countdown:
    """Traps the program at a pass through an address; to be closed when it has, or before a fault."""

    def __init__(
        self, process: Process, memory: TranslationMemory, address: int, passes: int, by_way_of: int = 0
    ) -> None:
        """Put the code into ``memory``: the ``passes``-th pass from now on is trapped before the instruction.

        The jump leads there by way of bytes nearby, if their address is given.

        :raises TranslationError: if it cannot be put there.
        """
        self._process, self.address = process, address
        code = process.read_memory(address, min(MOST_BYTES, _room(process, address)))
        taken = displaced(code, address, (), SHORT_JUMP_BYTES if by_way_of else JUMP_BYTES)
        if taken is None:
            message = f"no jump can be put at {address:#x}"
            raise TranslationError(message)
        word = memory.words(1)
        process.write_memory(word, _WORD.pack(passes))
        written, self.trapped_at = _countdown(memory.here, word, code, taken)
        process.write_memory(memory.here, written)
        self._jumps = [(by_way_of or address, jump(by_way_of or address, memory.here))]
        if by_way_of:
            self._jumps.append((address, short_jump(address, by_way_of)))
        self._true = [(at, process.read_memory(at, len(written))) for at, written in self._jumps[::-1]]
        self.put()

    def put(self) -> None:
        """Put the jump in its place, from which on passes are counted."""
        for at, written in self._jumps:
            self._process.write_memory(at, written)

    def close(self, process: Process | None = None) -> None:
        """Have the program's own code again, or that of a process that it has forked."""
        for at, true in self._true:
            (process or self._process).write_memory(at, true)

    def is_there(self) -> bool:
        """Whether the jump is in its place."""
        return all(self._process.read_memory(at, len(written)) == written for at, written in self._jumps)


def short_jump(at: int, target: int) -> bytes:
    """A jump of two bytes to a target that is less than 128 bytes away."""
    return _SHORT + _NEAR.pack(target - at - SHORT_JUMP_BYTES)


def bytes_nearby(at: int, is_free: Callable[[int], bool]) -> int:
    """Where, so near that a short jump at an address reaches it, a jump to anywhere fits in; 0 if nowhere.

    ``is_free`` tells of each byte whether it may be written.
    """
    after = at + SHORT_JUMP_BYTES
    free = 0
    for one in range(after - 128, after + 128 + JUMP_BYTES - 1):
        free = free + 1 if is_free(one) else 0
        if free == JUMP_BYTES:
            return one + 1 - JUMP_BYTES
    return 0


def _room(process: Process, address: int) -> int:
    mapping = process.maps().at(address)
    return mapping.end - address if mapping is not None else 0


def _countdown(at: int, word: int, code: bytes, taken: Displaced) -> tuple[bytes, int]:
    """The code, and where its thread stands behind the trap; registers, flags and stack are the program's."""
    out = BlockWriter(at)
    if not taken.flags_are_free:
        out.code += _KEEP
    out.referring(_DECREMENT, word)  # no lock: all threads have one processor
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
