"""Programs to be injected into: machine code in memory that a test shares with a process of its own.

A program repeats: wait for START, load every register from the page, say READY, spin until GO, dump every
register into the page, say DONE. What it executes while it spins and after it is up to the test.
"""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from iced_x86 import BlockEncoder, Code, Instruction, MemoryOperand, Register

from services.bus.announce import Announcement, boot_id, start_ticks

if TYPE_CHECKING:
    from iced_x86._iced_x86_py import Register as RegisterType

GENERAL = (
    *("rax", "rcx", "rdx", "rbx", "rsp", "rbp", "rsi", "rdi"),
    *(f"r{number}" for number in range(8, 16)),
)
_FLAGS = Path("/proc/cpuinfo").read_text().split()
HAS_AVX, HAS_AVX512 = "avx" in _FLAGS, "avx512bw" in _FLAGS
VECTORS = 32 if HAS_AVX512 else 16
WIDEST = "zmm" if HAS_AVX512 else "ymm" if HAS_AVX else "xmm"
VECTOR_BITS = {"xmm": 128, "ymm": 256, "zmm": 512}
MASKS = 8 if HAS_AVX512 else 0
PATIENCE_S = 30.0

_SIZE = 16384
START, READY, GO, DONE, ROUNDS = 8192, 8196, 8200, 8204, 8208
_GENERAL_IN, _GENERAL_OUT, _MASK_IN, _MASK_OUT = 8448, 8704, 8960, 9088
_VECTOR_IN, _VECTOR_OUT = 9216, 11264
_VECTOR_SIZE = VECTOR_BITS[WIDEST] // 8
_VECTOR_MOVES = {
    "xmm": (Code.MOVUPS_XMM_XMMM128, Code.MOVUPS_XMMM128_XMM),
    "ymm": (Code.VEX_VMOVUPS_YMM_YMMM256, Code.VEX_VMOVUPS_YMMM256_YMM),
    "zmm": (Code.EVEX_VMOVUPS_ZMM_K1Z_ZMMM512, Code.EVEX_VMOVUPS_ZMMM512_K1Z_ZMM),
}

_CHILD = """
import ctypes, mmap, sys, threading
libc = ctypes.CDLL(None)
libc.prctl(0x59616D61, ctypes.c_ulong(-1), 0, 0, 0)  # anybody may trace us
libc.prctl(1, 9)  # die with the test
page = mmap.mmap(int(sys.argv[1]), {size}, prot=7)
enter = ctypes.CFUNCTYPE(None)(ctypes.addressof(ctypes.c_char.from_buffer(page)))
for _ in range(int(sys.argv[2])):
    threading.Thread(target=threading.Event().wait, daemon=True).start()
print(ctypes.addressof(ctypes.c_char.from_buffer(page)), flush=True)
enter()
"""


def _at(offset: int) -> MemoryOperand:
    return MemoryOperand(Register.RIP, displ=offset, displ_size=8)


def _register(name: str) -> RegisterType:
    return getattr(Register, name.upper())  # type: ignore[no-any-return]


def _load_all() -> Iterator[Instruction]:
    for index, name in enumerate(GENERAL):
        place = _at(_GENERAL_IN + 8 * index)
        yield Instruction.create_reg_mem(Code.MOV_R64_RM64, _register(name), place)
    for index in range(VECTORS):
        place = _at(_VECTOR_IN + _VECTOR_SIZE * index)
        yield Instruction.create_reg_mem(_VECTOR_MOVES[WIDEST][0], _register(f"{WIDEST}{index}"), place)
    for index in range(MASKS):
        place = _at(_MASK_IN + 8 * index)
        yield Instruction.create_reg_mem(Code.VEX_KMOVQ_KR_KM64, _register(f"k{index}"), place)


def _dump_all() -> Iterator[Instruction]:
    for index, name in enumerate(GENERAL):
        place = _at(_GENERAL_OUT + 8 * index)
        yield Instruction.create_mem_reg(Code.MOV_RM64_R64, place, _register(name))
    for index in range(VECTORS):
        place = _at(_VECTOR_OUT + _VECTOR_SIZE * index)
        yield Instruction.create_mem_reg(_VECTOR_MOVES[WIDEST][1], place, _register(f"{WIDEST}{index}"))
    for index in range(MASKS):
        place = _at(_MASK_OUT + 8 * index)
        yield Instruction.create_mem_reg(Code.VEX_KMOVQ_M64_KR, place, _register(f"k{index}"))


def _wait_for(flag: int, label: int, spin: Sequence[Instruction]) -> Iterator[Instruction]:
    """Spin until a flag is set, and clear it."""
    yield from spin
    yield Instruction.create_mem_i32(Code.CMP_RM32_IMM32, _at(flag), 0)
    yield Instruction.create_branch(Code.JE_REL32_64, label)
    yield _set(flag, 0)


def _set(flag: int, value: int) -> Instruction:
    return Instruction.create_mem_i32(Code.MOV_RM32_IMM32, _at(flag), value)


_TOP, _SPIN = 1 << 20, 1 << 21


def assemble(
    spin: Sequence[Instruction] = (),
    after: Sequence[Instruction] = (),
    before: Sequence[Instruction] = (),
) -> bytes:
    """The program, with ``spin`` executed over and over until GO, ``before`` and ``after`` that once."""
    count = Instruction.create_mem_i32(Code.ADD_RM64_IMM32, _at(ROUNDS), 1)
    parts = [
        (_TOP, list(_wait_for(START, _TOP, [Instruction.create(Code.PAUSE)]))),
        (0, [*_load_all(), *before, _set(READY, 1)]),
        (_SPIN, list(_wait_for(GO, _SPIN, [*spin, count]))),
        (0, [*after, *_dump_all(), _set(DONE, 1)]),
        (0, [Instruction.create_branch(Code.JMP_REL32_64, _TOP)]),
    ]
    encoder = BlockEncoder(64)
    for label, instructions in parts:
        if label:
            instructions[0].ip = label
        encoder.add_many(instructions)
    return encoder.encode(0)


class TargetEndedError(Exception):
    """The target's process has ended."""


class Target:
    """A process that runs a program, and the page that it shares with us."""

    def __init__(self, program: bytes, threads: int = 0) -> None:
        descriptor = os.memfd_create("program")
        os.ftruncate(descriptor, _SIZE)
        self.page = mmap.mmap(descriptor, _SIZE)
        self.page[: len(program)] = program
        arguments = [
            sys.executable,
            "-I",
            "-S",
            "-c",
            _CHILD.format(size=_SIZE),
            str(descriptor),
            str(threads),
        ]
        self.process = subprocess.Popen(arguments, pass_fds=[descriptor], stdout=subprocess.PIPE)
        os.close(descriptor)
        self.pid = self.process.pid
        assert self.process.stdout is not None
        self.address = int(self.process.stdout.readline())

    def announcement(self) -> Announcement:
        return Announcement("node", self.pid, self.pid, start_ticks(self.pid), boot_id())

    def _word(self, offset: int, size: int = 8) -> int:
        return int.from_bytes(self.page[offset : offset + size], "little")

    def start(
        self,
        general: dict[str, int] | None = None,
        vector: dict[int, int] | None = None,
        mask: dict[int, int] | None = None,
    ) -> None:
        """Begin a round with these values of registers, 0 for the others; returns when it spins."""
        for index, name in enumerate(GENERAL):
            value = (general or {}).get(name, 0)
            self.page[_GENERAL_IN + 8 * index : _GENERAL_IN + 8 * index + 8] = value.to_bytes(8, "little")
        for index in range(VECTORS):
            at = _VECTOR_IN + _VECTOR_SIZE * index
            content = (vector or {}).get(index, 0).to_bytes(_VECTOR_SIZE, "little")
            self.page[at : at + _VECTOR_SIZE] = content
        for index in range(MASKS):
            at = _MASK_IN + 8 * index
            self.page[at : at + 8] = (mask or {}).get(index, 0).to_bytes(8, "little")
        self.page[READY] = self.page[DONE] = self.page[GO] = 0
        self.page[START] = 1
        self.wait(READY)

    def go(self) -> None:
        """End the spinning; the program goes on as soon as it may."""
        self.page[GO] = 1

    def finish(self) -> None:
        """End the round; afterwards the dump tells what the program saw in its registers."""
        self.go()
        self.wait(DONE)

    def wait(self, flag: int) -> None:
        self._wait(lambda: bool(self.page[flag]))

    def _wait(self, reached: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not reached():
            if self.process.poll() is not None:
                raise TargetEndedError(self.process.returncode)
            assert time.monotonic() < deadline, "the target does not go on"
            os.sched_yield()

    @property
    def rounds(self) -> int:
        """How often it went round while spinning."""
        return self._word(ROUNDS)

    def wait_for_progress(self, rounds: int = 1000) -> None:
        """Return when it has gone round that many times more."""
        end = self.rounds + rounds
        self._wait(lambda: self.rounds >= end)

    def use_time(self, duration_ns: int) -> None:
        """Return when its thread has used that much processor time more."""
        end = clock_ns(self.pid) + duration_ns
        self._wait(lambda: clock_ns(self.pid) >= end)

    def general(self) -> dict[str, int]:
        """The dumped general registers."""
        return {name: self._word(_GENERAL_OUT + 8 * index) for index, name in enumerate(GENERAL)}

    def vector(self) -> dict[int, int]:
        """The dumped vector registers, as many and as wide as the processor has them."""
        return {
            index: self._word(_VECTOR_OUT + _VECTOR_SIZE * index, _VECTOR_SIZE) for index in range(VECTORS)
        }

    def mask(self) -> dict[int, int]:
        """The dumped mask registers; none without AVX-512."""
        return {index: self._word(_MASK_OUT + 8 * index) for index in range(MASKS)}

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        self.page.close()


@contextmanager
def running(program: bytes, threads: int = 0) -> Iterator[Target]:
    """A target, with ``threads`` more threads that sleep; gone afterwards."""
    target = Target(program, threads)
    try:
        yield target
    finally:
        target.close()


def state(tid: int) -> str:
    """The state of a thread: R running, S sleeping, t traced and standing, T stopped."""
    return Path(f"/proc/{tid}/stat").read_text().rpartition(")")[2].split()[0]


def clock_ns(tid: int) -> int:
    """The processor time that a thread has used."""
    return int(Path(f"/proc/{tid}/schedstat").read_text().split()[0])
