"""Machine code around an instruction in translation that leads to a strike, or strikes by itself.

It leaves registers, flags and stack as they are but for the strike. Where the injector is to strike, it
traps; the injector has the thread go on at the code's ``end``, with the rcx that the code has kept.

Source: Intel SDM volume 2 (encodings).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import iced_x86
from iced_x86 import Code, Encoder, MemoryOperand, Register

from injector.block_profile.translation_memory import TranslationMemory
from injector.block_profile.x86_64_translator import TRAP
from injector.isa.instruction import Candidate
from injector.isa.x86_64_registers import GENERAL, STATUS_FLAGS, VECTOR, RegisterPart

OFF, TRAPPING, STRIKING = 0, 1, 2
"""What the code of a defect does: nothing, trap, or strike."""

_STORE_RCX, _LOAD_RCX = b"\x48\x89\x0d", b"\x48\x8b\x0d"  # mov [rip+d],rcx and back
_STORE_RAX, _LOAD_RAX = b"\x48\x89\x05", b"\x48\x8b\x05"
_STORE_RSP, _LOAD_RSP, _POINT_RSP = b"\x48\x89\x25", b"\x48\x8b\x25", b"\x48\x8d\x25"  # the last: lea
_RCX_LESS_ONE = b"\x48\x8d\x49\xff"  # lea rcx,[rcx-1]
_TRAP_AT_ZERO = b"\xe3\x02\xeb\x01" + TRAP  # jrcxz to the trap, jmp over it
_SORT_BY_RCX = b"\xe3\x08" + _RCX_LESS_ONE + b"\xe3\x07\xeb\x06"  # 0: on; 1: six on; else seven on
_JUMP = b"\xe9"
_RAX_IS, _RCX_IS = b"\x48\xb8", b"\x48\xb9"  # mov rax,n
_AND_RCX, _COMPARE_RCX = b"\x48\x21\xc8", b"\x48\x39\xc8"  # and rax,rcx; cmp rax,rcx
_RCX_OFF_IF_UNEQUAL = b"\xb8\0\0\0\0\x48\x0f\x45\xc8"  # mov eax,OFF; cmovne rcx,rax
_XOR_WITH_RAX, _XOR_RAX, _OR_WITH_RAX = b"\x48\x31\x05", b"\x48\x33\x05", b"\x48\x09\x05"
_INCREMENT = b"\x48\xff\x05"
_PUSH_FLAGS, _POP_FLAGS, _XOR_FLAGS = b"\x9c", b"\x9d", b"\x48\x81\x34\x24"  # the last: xor qword [rsp],n
_DISPLACEMENT, _WORD = struct.Struct("<i"), struct.Struct("<Q")
_WORDS = 8
"""Of the largest register."""


class UnstrikableError(ValueError):
    """There is no code that strikes such a register."""


@dataclass(frozen=True, slots=True)
class ControlWords:
    """Addresses of the words by which the injector and such code know of each other.

    ``left``: executions to the next trap. ``mode``: see :data:`OFF`; ``matched``: the mode, or OFF if an
    operand is not what a defect needs. ``strikes`` counts what struck; ``unread`` is not zero if a register
    was not what it was to become. ``rcx`` and the like keep registers.
    """

    rcx: int
    rax: int
    rsp: int
    left: int
    mode: int
    matched: int
    strikes: int
    unread: int
    register: int
    read_back: int
    stack: int

    @classmethod
    def in_memory(cls, memory: TranslationMemory) -> ControlWords:
        """Words of their own in the memory for translations."""
        rcx, rax, rsp, left, mode, matched, strikes, unread = (memory.words(1) for _ in range(8))
        register, read_back = memory.words(_WORDS), memory.words(_WORDS)
        memory.words(_STACK)
        stack = memory.words(1)
        return cls(rcx, rax, rsp, left, mode, matched, strikes, unread, register, read_back, stack)


_STACK = 2048
"""Words for the flags, and should a signal come just then, for its handler."""


class CountdownCode:
    """Code before an instruction that traps at each execution that the count ``left`` names."""

    def __init__(self, words: ControlWords) -> None:
        self._words = words
        self.trapped_at = self.end = 0

    def before(self, at: int) -> bytes:
        """The code: it counts one execution less, and traps at zero."""
        out, words = _Assembly(at), self._words
        out.beside(_STORE_RCX, words.rcx)
        out.beside(_LOAD_RCX, words.left)
        out.put(_RCX_LESS_ONE)
        out.beside(_STORE_RCX, words.left)
        out.put(_TRAP_AT_ZERO)
        self.trapped_at = out.here
        out.beside(_LOAD_RCX, words.rcx)
        self.end = out.here
        return bytes(out.code)

    def after(self, at: int) -> bytes:
        """No code: nothing happens behind the instruction."""
        del at
        return b""


@dataclass(frozen=True, slots=True)
class InputPattern:
    """What an ``operand`` must hold for a defect to show: in the bits of ``mask``, those of ``value``."""

    operand: Candidate
    mask: int
    value: int


class DefectCode:
    """Code that inverts bits of a register: of a source before the instruction, of a destination after it."""

    def __init__(
        self,
        words: ControlWords,
        operand: Candidate,
        mask: int,
        pattern: InputPattern | None = None,
        *,
        wide: bool,
    ) -> None:
        """Invert the bits of ``mask`` in ``operand``. The processor is ``wide`` if it has AVX-512.

        :raises UnstrikableError: if it is no register that can be struck so.
        """
        self._words, self._operand, self._mask, self._pattern = words, operand, mask, pattern
        self._moves = _moves(operand, wide=wide)
        self._moves_in = None if pattern is None else _moves(pattern.operand, wide=wide)
        self.trapped_at = self.end = 0

    def before(self, at: int) -> bytes:
        """The code that looks at what is read, if it matters, and strikes, if the operand is a source."""
        out = _Assembly(at)
        if self._pattern is not None:
            self._write_match(out, self._pattern)
        if self._operand.role == "source":
            out.put(self._code(out.here))
        return bytes(out.code)

    def after(self, at: int) -> bytes:
        """The code, if the operand is a destination."""
        return self._code(at) if self._operand.role == "destination" else b""

    def _code(self, at: int) -> bytes:
        words, strike = self._words, _Assembly(0)
        for _ in range(2):  # how far it is to the end is known once it is written
            out, size = _Assembly(at), len(strike.code)
            out.beside(_STORE_RCX, words.rcx)
            out.beside(_LOAD_RCX, words.mode if self._pattern is None else words.matched)
            out.put(_SORT_BY_RCX)
            out.put(_JUMP + _DISPLACEMENT.pack(len(TRAP) + size))
            out.put(TRAP)
            self.trapped_at = out.here
            strike = _Assembly(out.here)
            self._write_strike(strike)
        out.put(bytes(strike.code))
        out.beside(_LOAD_RCX, words.rcx)
        self.end = out.here
        return bytes(out.code)

    def _write_match(self, out: _Assembly, pattern: InputPattern) -> None:
        words = self._words
        out.beside(_STORE_RCX, words.rcx)
        self._keep(out)
        part = GENERAL.get(pattern.operand.register)
        shift = 0 if part is None else part.shift
        kept = None if part is None else self._kept(part)
        if kept is not None:
            out.beside(_LOAD_RAX, kept)
        else:
            assert self._moves_in is not None  # noqa: S101 - flags are no named operand
            store, _, register = self._moves_in
            out.store(store, register, words.register)
            out.beside(_LOAD_RAX, words.register)
        out.put(_RCX_IS + _WORD.pack(pattern.mask << shift))
        out.put(_AND_RCX)
        out.put(_RCX_IS + _WORD.pack(pattern.value << shift))
        out.put(_COMPARE_RCX)
        out.beside(_LOAD_RCX, words.mode)
        out.put(_RCX_OFF_IF_UNEQUAL)
        out.beside(_STORE_RCX, words.matched)
        self._restore(out)
        out.beside(_LOAD_RCX, words.rcx)

    def _keep(self, out: _Assembly) -> None:
        """Keep rax, rsp and flags; rcx is kept."""
        words = self._words
        out.beside(_STORE_RAX, words.rax)
        out.beside(_STORE_RSP, words.rsp)
        out.beside(_POINT_RSP, words.stack)
        out.put(_PUSH_FLAGS)

    def _restore(self, out: _Assembly) -> None:
        out.put(_POP_FLAGS)
        out.beside(_LOAD_RSP, self._words.rsp)
        out.beside(_LOAD_RAX, self._words.rax)

    def _kept(self, part: RegisterPart) -> int | None:
        """Where a register is kept, if the code needs it for itself."""
        words = self._words
        return {"rax": words.rax, "rcx": words.rcx, "rsp": words.rsp}.get(part.whole)

    def _write_strike(self, out: _Assembly) -> None:
        words = self._words
        self._keep(out)
        if self._operand.register_class == "flags":
            assert self._mask < 1 << max(STATUS_FLAGS) + 1  # noqa: S101 - they are drawn of these
            out.put(_XOR_FLAGS + _DISPLACEMENT.pack(self._mask))
        elif self._operand.register_class == "gpr":
            self._write_general(out)
        else:
            assert self._moves is not None  # noqa: S101 - all but flags are moved
            self._write_moved(out, self._mask, *self._moves)
        out.beside(_INCREMENT, words.strikes)
        self._restore(out)

    def _write_general(self, out: _Assembly) -> None:
        part = GENERAL[self._operand.register]
        mask = self._mask << part.shift
        kept = self._kept(part)
        if kept is not None:  # it is loaded from there
            out.put(_RAX_IS + _WORD.pack(mask))
            out.beside(_XOR_WITH_RAX, kept)
            return
        assert self._moves is not None  # noqa: S101 - all but flags are moved
        self._write_moved(out, mask, *self._moves)

    def _write_moved(self, out: _Assembly, mask: int, store: int, load: int, register: int) -> None:
        words = self._words
        struck = [(8 * n, word) for n in range(_WORDS) if (word := mask >> 64 * n & 2**64 - 1)]
        out.store(store, register, words.register)
        for place, word in struck:
            out.put(_RAX_IS + _WORD.pack(word))
            out.beside(_XOR_WITH_RAX, words.register + place)
        out.load(load, register, words.register)
        out.store(store, register, words.read_back)
        for place, _ in struck:
            out.beside(_LOAD_RAX, words.register + place)
            out.beside(_XOR_RAX, words.read_back + place)
            out.beside(_OR_WITH_RAX, words.unread)


def _moves(operand: Candidate, *, wide: bool) -> tuple[int, int, int] | None:
    """The codes that store and load a register and nothing beside it, and its number; None for flags."""
    name = operand.register
    if operand.register_class == "flags":
        return None
    if operand.register_class == "gpr":
        return Code.MOV_RM64_R64, Code.MOV_R64_RM64, getattr(Register, GENERAL[name].whole.upper())
    if operand.register_class == "mask":
        return Code.VEX_KMOVQ_M64_KR, Code.VEX_KMOVQ_KR_KM64, getattr(Register, name.upper())
    if name not in VECTOR:
        raise UnstrikableError(name)
    number, size = VECTOR[name]
    if size == 16 and number < 16:  # these leave what is above as it is
        return Code.MOVUPS_XMMM128_XMM, Code.MOVUPS_XMM_XMMM128, getattr(Register, f"XMM{number}")
    if wide:
        whole = getattr(Register, f"ZMM{number}")
        return Code.EVEX_VMOVUPS_ZMMM512_K1Z_ZMM, Code.EVEX_VMOVUPS_ZMM_K1Z_ZMMM512, whole
    return Code.VEX_VMOVUPS_YMMM256_YMM, Code.VEX_VMOVUPS_YMM_YMMM256, getattr(Register, f"YMM{number}")


class _Assembly:
    """Code that is written one instruction after the other, for one address."""

    def __init__(self, at: int) -> None:
        self.code = bytearray()
        self._at = at

    @property
    def here(self) -> int:
        """Where the next instruction comes to lie."""
        return self._at + len(self.code)

    def put(self, code: bytes) -> None:
        self.code += code

    def beside(self, opcode: bytes, address: int) -> None:
        """Write an instruction whose memory operand is told by its distance from the program counter."""
        after = self.here + len(opcode) + _DISPLACEMENT.size
        self.code += opcode + _DISPLACEMENT.pack(address - after)

    def store(self, code: int, register: int, address: int) -> None:
        self._encode(iced_x86.Instruction.create_mem_reg(code, _operand(address), register))  # type: ignore[arg-type]

    def load(self, code: int, register: int, address: int) -> None:
        self._encode(iced_x86.Instruction.create_reg_mem(code, register, _operand(address)))  # type: ignore[arg-type]

    def _encode(self, instruction: iced_x86.Instruction) -> None:
        encoder = Encoder(64)
        encoder.encode(instruction, self.here)
        self.code += encoder.take_buffer()


def _operand(address: int) -> MemoryOperand:
    return MemoryOperand(Register.RIP, displ=address, displ_size=8)
