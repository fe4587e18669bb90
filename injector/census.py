"""Which functions a call enters, and how often: so that no part of it is overlooked.

A copy of the call runs with a breakpoint instruction at every function that a loaded file tells of. Few of
them are entered, and each only so often is let pass with a report. x86-64 only.
"""

from __future__ import annotations

import mmap
from collections import Counter, defaultdict
from collections.abc import Iterable

from injector import ptrace
from injector.copies import Copies
from injector.elf import functions
from injector.process import Identity, Process
from injector.thread import Thread

MOST = 300
"""Entries of a function beyond which it counts as entered as often as that."""

_INT3 = b"\xcc"


class CensusError(Exception):
    """The copy did not go through its call: one line."""


def census(copies: Copies, root: Thread, mark: int) -> dict[int, int]:
    """How often the call at whose beginning ``root`` stands enters each function that it enters.

    At most ``MOST`` is told, in the order of first entry. The call ends with signal ``mark``.

    :raises CensusError: if it ends otherwise.
    """
    copy = copies.copy(root)
    try:
        with Process(Identity.of(copy.pid)) as process:
            every = {
                address
                for piece in process.maps().code()
                if piece.path
                for _, address in functions(copy.pid, piece)
            }
            return _counted(copy, process, _set(process, every), mark)
    finally:
        copies.end(copy)


def _set(process: Process, addresses: Iterable[int]) -> dict[int, bytes]:
    """A breakpoint instruction at each address; what was there before."""
    pages: dict[int, list[int]] = defaultdict(list)
    for address in sorted(addresses):
        pages[address - address % mmap.PAGESIZE].append(address)
    true: dict[int, bytes] = {}
    for page, those in pages.items():
        content = bytearray(process.read_memory(page, mmap.PAGESIZE))
        for address in those:
            at = address - page
            true[address] = bytes(content[at : at + 1])
            content[at : at + 1] = _INT3
        process.write_memory(page, bytes(content))
    return true


def _counted(copy: Thread, process: Process, true: dict[int, bytes], mark: int) -> dict[int, int]:
    entries: Counter[int] = Counter()
    while True:
        ptrace.resume(copy.tid)
        report = ptrace.await_report(copy.tid)
        if report.kind == "signal" and report.signal == mark:
            return dict(entries)
        address = ptrace.program_counter(copy.tid) - len(_INT3) if report.kind != "gone" else 0
        if address not in true:
            message = f"a copy with breakpoints did not end its call but reported {report.kind}"
            raise CensusError(f"{message} (signal {report.signal})")
        entries[address] += 1
        process.write_memory(address, true[address])
        ptrace.go_to(copy.tid, address)
        if entries[address] < MOST:
            ptrace.step(copy.tid)
            if ptrace.await_report(copy.tid).kind != "step":
                raise CensusError("a copy with breakpoints did not take a step")
            process.write_memory(address, _INT3)
