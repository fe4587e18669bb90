"""Where the vector and mask registers lie in XSAVE's standard format, which ptrace uses.

Offsets differ between makers (AMD has no MPX, so its AVX-512 state lies lower), so the processor is
asked: CPUID leaf 0xD. Source: Intel SDM volume 1, chapter 13; Linux Documentation/arch/x86/xstate.rst.
"""

from __future__ import annotations

import ctypes
import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

SSE, AVX, OPMASK, ZMM_HIGH, HIGH_ZMM = 1, 2, 5, 6, 7
"""State components: xmm0-15, upper halves of ymm0-15, k0-7, upper halves of zmm0-15, zmm16-31 whole."""

ENABLED_AT, XSTATE_BV_AT = 464, 512
"""Offsets of XCR0 (put there by the kernel) and of the mask of components that are not in initial state."""

LARGEST = 16384
"""Bytes, enough for every component there is (AMX tiles: 8 KiB)."""

_XMM_AT = 160
_CPUID_LEAF = 0xD
_CPUID_CODE = bytes.fromhex(
    "53"  # push rbx
    "4989d0"  # mov r8, rdx
    "89f8"  # mov eax, edi
    "89f1"  # mov ecx, esi
    "0fa2"  # cpuid
    "418900"  # mov [r8], eax
    "41895804"  # mov [r8+4], ebx
    "41894808"  # mov [r8+8], ecx
    "4189500c"  # mov [r8+12], edx
    "5b"  # pop rbx
    "c3"  # ret
)
_XGETBV_CODE = bytes.fromhex(
    "31c9"  # xor ecx, ecx
    "0f01d0"  # xgetbv
    "48c1e220"  # shl rdx, 32
    "4809d0"  # or rax, rdx
    "c3"  # ret
)
_OSXSAVE = 1 << 27


@dataclass(frozen=True, slots=True)
class StateComponent:
    """Consecutive bytes of a register in the buffer."""

    component: int
    offset: int
    size: int


def cpuid(leaf: int, subleaf: int) -> tuple[int, int, int, int]:
    """eax, ebx, ecx and edx of CPUID."""
    result = (ctypes.c_uint32 * 4)()
    _run(_CPUID_CODE, leaf, subleaf, ctypes.addressof(result))
    return result[0], result[1], result[2], result[3]


@cache
def enabled() -> int:
    """The state components that processor and kernel have in use here, as a mask (XCR0)."""
    if not cpuid(1, 0)[2] & _OSXSAVE:
        return 1 << SSE
    return _run(_XGETBV_CODE, 0, 0, 0)


def _run(code: bytes, first: int, second: int, third: int) -> int:
    """Call machine code with three integers: Python cannot execute these instructions otherwise."""
    page = mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    page.write(code)
    anchor = ctypes.c_char.from_buffer(page)
    kind = ctypes.CFUNCTYPE(ctypes.c_uint64, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_void_p)
    result = int(kind(ctypes.addressof(anchor))(first, second, third))
    del anchor
    page.close()
    return result


@cache
def offset_of(component: int) -> int:
    """Where a component lies in the standard format (CPUID.0xD.component: EBX)."""
    return cpuid(_CPUID_LEAF, component)[1]


def pieces(number: int, size: int) -> Iterator[StateComponent]:
    """The pieces of vector register ``number``, ``size`` bytes wide (16, 32 or 64), lowest first."""
    if number >= 16:
        yield StateComponent(HIGH_ZMM, offset_of(HIGH_ZMM) + 64 * (number - 16), size)
        return
    yield StateComponent(SSE, _XMM_AT + 16 * number, 16)
    if size >= 32:
        yield StateComponent(AVX, offset_of(AVX) + 16 * number, 16)
    if size >= 64:
        yield StateComponent(ZMM_HIGH, offset_of(ZMM_HIGH) + 32 * number, 32)


def mask_piece(number: int) -> StateComponent:
    """Where mask register ``number`` lies."""
    return StateComponent(OPMASK, offset_of(OPMASK) + 8 * number, 8)
