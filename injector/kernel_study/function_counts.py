"""Counts of the functions that a call enters, so that no part of the call is overlooked.

A copy of the call runs with a breakpoint instruction at every function that a loaded file tells of. Few of
them are entered, and each only so often is let pass with a report. x86-64 only.
"""

from __future__ import annotations

import mmap
from collections import Counter, defaultdict
from collections.abc import Iterable

from injector.kernel_study.remote_fork import RemoteForks
from injector.tracing import ptrace
from injector.tracing.elf import functions
from injector.tracing.process import Process, ProcessIdentity
from injector.tracing.tracee import Tracee

MOST = 300
"""Entries of a function beyond which it counts as entered as often as that."""

_INT3 = b"\xcc"


class FunctionCountError(Exception):
    """The copy did not go through its call: one line."""


def count_functions(forks: RemoteForks, root: Tracee, mark: int) -> dict[int, int]:
    """How often the call at whose beginning ``root`` stands enters each function that it enters.

    At most ``MOST`` is told, in the order of first entry. The call ends with signal ``mark``.

    :raises FunctionCountError: if it ends otherwise.
    """
    copy = forks.copy(root)
    try:
        with Process(ProcessIdentity.of(copy.pid)) as process:
            every = {
                address
                for piece in process.maps().code()
                if piece.path
                for _, address in functions(copy.pid, piece)
            }
            return _counted(copy, process, _set(process, every), mark)
    finally:
        forks.end(copy)


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


def _counted(copy: Tracee, process: Process, true: dict[int, bytes], mark: int) -> dict[int, int]:
    entries: Counter[int] = Counter()
    while True:
        ptrace.resume(copy.tid)
        report = ptrace.await_report(copy.tid)
        if report.kind == "signal" and report.signal == mark:
            return dict(entries)
        address = ptrace.program_counter(copy.tid) - len(_INT3) if report.kind != "gone" else 0
        if address not in true:
            message = f"a copy with breakpoints did not end its call but reported {report.kind}"
            raise FunctionCountError(f"{message} (signal {report.signal})")
        entries[address] += 1
        process.write_memory(address, true[address])
        ptrace.go_to(copy.tid, address)
        if entries[address] < MOST:
            ptrace.step(copy.tid)
            if ptrace.await_report(copy.tid).kind != "step":
                raise FunctionCountError("a copy with breakpoints did not take a step")
            process.write_memory(address, _INT3)
