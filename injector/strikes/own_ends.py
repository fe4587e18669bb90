"""What a copy of a node gets of its own: its end of a socket, and the page of counters.

A copy shares descriptors and shared memory with whom it is a copy of. Before it goes on, the kernel is asked
on its behalf for a socket in the place of the one to the proxy, and for private memory in the place of the
page.
"""

from __future__ import annotations

import mmap
import os
import socket
import struct
from pathlib import Path

from injector.block_profile.injected_call import injected_call
from injector.isa.host import HOST
from injector.tracing.process import Process
from injector.tracing.tracee import Tracee
from services.system.libc import libc

_SOCKETPAIR, _DUP2, _CLOSE, _MMAP = 53, 33, 3, 9  # numbers of system calls on x86-64
_PIDFD_GETFD = 438
_PRIVATE_FIXED = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | 0x10
_NOWHERE = 2**64 - 1
_PAIR = struct.Struct("=2i")
_BELOW = 16384
"""Bytes below the stack pointer, where nothing is kept."""


class OwnEndError(Exception):
    """A copy could not be given what it needs: one line."""


def link_of(pid: int) -> int:
    """The descriptor of a node's socket to its proxy, the only socket that it has.

    :raises OwnEndError: if it has none, or several.
    """
    folder = Path(f"/proc/{pid}/fd")
    found = [int(one.name) for one in folder.iterdir() if str(one.readlink()).startswith("socket:")]
    if len(found) != 1:
        message = f"process {pid} has {len(found)} sockets, expected one"
        raise OwnEndError(message)
    return found[0]


def own_link(copy: Tracee, process: Process, link: int, stack_pointer: int) -> socket.socket:
    """Give a standing copy a socket of its own for ``link``; the other end of that.

    :raises OwnEndError: if the kernel refuses.
    """
    scratch = (stack_pointer - _BELOW) & ~0xF
    kept = process.read_memory(scratch, _PAIR.size)
    _done(injected_call(copy.tid, process, _SOCKETPAIR, socket.AF_UNIX, socket.SOCK_STREAM, 0, scratch))
    theirs, ours = _PAIR.unpack(process.read_memory(scratch, _PAIR.size))
    process.write_memory(scratch, kept)
    pidfd = os.pidfd_open(copy.pid)
    try:
        taken = _done(libc.syscall(_PIDFD_GETFD, pidfd, ours, 0))
    finally:
        os.close(pidfd)
    _done(injected_call(copy.tid, process, _DUP2, theirs, link))
    for one in (theirs, ours):
        _done(injected_call(copy.tid, process, _CLOSE, one))
    return socket.socket(fileno=taken)


def own_page(copy: Tracee, process: Process) -> int:
    """Have a standing copy count in memory of its own, beginning with what the shared page has; where it is.

    :raises OwnEndError: if it has no such page, or the kernel refuses.
    """
    shared = [one for one in process.maps().writable() if one.name.startswith("/memfd:zenfi-")]
    if len(shared) != 1:
        message = f"process {copy.pid} has {len(shared)} shared pages, expected one"
        raise OwnEndError(message)
    start, size = shared[0].start, shared[0].end - shared[0].start
    content = process.read_memory(start, size)
    protection = mmap.PROT_READ | mmap.PROT_WRITE
    _done(injected_call(copy.tid, process, _MMAP, start, size, protection, _PRIVATE_FIXED, _NOWHERE, 0))
    process.write_memory(start, content)
    return start


def stack_pointer(thread: Tracee) -> int:
    """Where the stack of a standing thread ends."""
    return HOST.registers(thread.tid).stack_pointer


def _done(result: int) -> int:
    if result < 0:
        message = f"a system call on behalf of a copy failed: {os.strerror(-result)}"
        raise OwnEndError(message)
    return result
