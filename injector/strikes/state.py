"""The state of a standing copy of a node, compared with that of another copy of the same node.

Two copies that stand at the same system call of C code go on alike if their memory is the same, and those
registers that a call leaves alone: everything else is written before it is read (System V ABI, 3.2.1).
Memory below the stack pointer is nobody's, and where the C library has the kernel write on which processor a
thread runs (rseq(2)) is no business of a program's. Copies share with their root what they have not written,
so only pages that one of both has for itself are read.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import mmap
import os
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from injector.tracing import ptrace
from injector.tracing.process import AddressError, MemoryMap, MemoryMapping, Process
from injector.tracing.ptrace import NT_PRSTATUS, NT_X86_XSTATE
from injector.tracing.tracee import Tracee
from services.system.libc import libc
from services.system.process_stat import own_number

_PAGE = mmap.PAGESIZE
_ENTRY = 8
_PRESENT, _EXCLUSIVE = 1 << 63, 1 << 56
_RED_ZONE = 128
_GENERAL = struct.Struct("=27Q")
_KEPT = (0, 1, 2, 3, 4, 5, 16, 19, 21, 22)
"""r15, r14, r13, r12, rbp, rbx, rip, rsp, fs_base, gs_base: of struct user_regs_struct."""
_THREAD = 8
"""Place of fs_base among them."""
_RSEQ_SIZE = 32
_OWN_NUMBER = -1
"""In the place of a copy's own pid: it has just asked for it, to send itself the mark."""
_CONTROL_AT, _MXCSR_AT = 0, 24
"""Of the x87 control word and MXCSR in the legacy part of the extended state (Intel SDM volume 1, 13.4.1)."""
_EXTENDED = 1 << 14


@dataclass(frozen=True, slots=True)
class CopyState:
    """What a standing copy may differ in: registers, extents of its memory, pages of its own by address."""

    registers: tuple[int, ...]
    extents: tuple[str, ...]
    pages: Mapping[int, bytes]
    stack_pointer: int


def state_of(thread: Tracee, process: Process, shared: frozenset[int] = frozenset()) -> CopyState:
    """The state of a standing copy.

    ``shared`` are pages that it may share with whom it was copied from, who had written them.
    """
    general = _GENERAL.unpack(ptrace.read_registers(thread.tid, NT_PRSTATUS, _GENERAL.size))
    extended = ptrace.read_registers(thread.tid, NT_X86_XSTATE, _EXTENDED)
    (control,) = struct.unpack_from("<H", extended, _CONTROL_AT)
    (mxcsr,) = struct.unpack_from("<I", extended, _MXCSR_AT)
    maps = process.maps()
    pages = dict(_contents(process, shared | own_pages(process, maps)))
    number = own_number(process.pid)
    kept = (general[place] for place in _KEPT)
    registers = (*(_OWN_NUMBER if value == number else value for value in kept), control, mxcsr)
    return CopyState(registers, maps.extents, pages, general[_KEPT[7]])


def own_pages(process: Process, maps: MemoryMap | None = None) -> frozenset[int]:
    """The addresses of pages that a copy has written since it was made, and so has for itself."""
    found: set[int] = set()
    wanted = np.uint64(_EXCLUSIVE | _PRESENT)
    pagemap = os.open(f"/proc/{process.pid}/pagemap", os.O_RDONLY | os.O_CLOEXEC)
    try:
        for mapping in (maps or process.maps()).writable():
            if "p" in mapping.permissions:
                own = np.flatnonzero((_entries(pagemap, mapping) & wanted) == wanted)
                found.update((mapping.start + own * _PAGE).tolist())
    finally:
        os.close(pagemap)
    return frozenset(found)


def difference(one: CopyState, other: CopyState, root: Process) -> str:
    """In what a copy differs from another copy of ``root``, which stands where both began: a digest.

    Empty if both go on alike from where they stand. Copies that differ from a third in the same go on alike.
    """
    told = hashlib.blake2b(digest_size=16)
    limit = one.stack_pointer - _RED_ZONE
    same = (one.registers, one.extents) == (other.registers, other.extents)
    if not same:
        told.update(repr((one.registers, one.extents)).encode())
    maps = root.maps()
    stack = maps.at(one.stack_pointer)
    assert stack is not None  # noqa: S101 - it stands there
    rseq = one.registers[_THREAD] + _rseq_offset()

    def content(state: CopyState, page: int) -> bytes:
        own = state.pages.get(page)
        if own is not None:
            return own
        # What the other copy alone has, the extents tell. To read it in the root might have its stack grow.
        return b"" if maps.at(page) is None else root.read_memory(page, _PAGE)

    for page in sorted({*one.pages, *other.pages}):
        begin = 0
        if stack.start <= page < stack.end:
            begin = min(max(limit - page, 0), _PAGE)
        first, second = (_without(content(state, page), rseq - page)[begin:] for state in (one, other))
        if first != second:
            same = False
            told.update(page.to_bytes(8, "little") + begin.to_bytes(8, "little") + first)
    return "" if same else told.hexdigest()


@functools.cache
def _rseq_offset() -> int:
    """From a thread's own block to what the kernel writes; far from everything if it writes nothing."""
    try:
        return ctypes.c_ssize_t.in_dll(libc, "__rseq_offset").value
    except ValueError:
        return -(1 << 62)


def _without(page: bytes, begin: int) -> bytes:
    """A page without what the kernel has written from ``begin`` on."""
    if not 0 <= begin < _PAGE:
        return page
    return page[:begin] + page[begin + _RSEQ_SIZE :]


def _contents(process: Process, pages: Iterable[int]) -> Iterator[tuple[int, bytes]]:
    """Pages with their contents; neighbours are read at once. One that is gone is left out."""
    ordered = np.array(sorted(pages), np.int64)
    for run in np.split(ordered, np.flatnonzero(np.diff(ordered) != _PAGE) + 1):
        if not len(run):
            continue
        try:
            content = process.read_memory(int(run[0]), len(run) * _PAGE)
        except AddressError:  # unmapped meanwhile, which the extents tell
            continue
        for number, page in enumerate(run.tolist()):
            yield page, content[number * _PAGE : (number + 1) * _PAGE]


def _entries(pagemap: int, mapping: MemoryMapping) -> NDArray[np.uint64]:
    """The kernel's account of each page (Linux Documentation/admin-guide/mm/pagemap.rst)."""
    count = (mapping.end - mapping.start) // _PAGE
    return np.frombuffer(os.pread(pagemap, count * _ENTRY, mapping.start // _PAGE * _ENTRY), np.uint64)
