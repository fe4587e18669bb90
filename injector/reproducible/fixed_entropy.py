"""The keys that the kernel draws for a program, made the same for all.

A register that holds one, or a number made with it, would be another in each process: the stack's canary and
the key of mangled pointers (``AT_RANDOM`` of getauxval(3)), and the key by which malloc knows what was freed
(the first bytes that glibc gets from getrandom(2)). So are the keys of hash tables that modules draw as they
are imported: in which order such a table is gone through decides where what is made of it comes to lie.
"""

from __future__ import annotations

import os
import platform
import socket
import struct
from contextlib import suppress
from pathlib import Path

from injector.tracing import ptrace
from services.system.libc import libc

_KEYS = bytes.fromhex("5a1d0c6e93b8274fe1a4c35f7e926bd8")
_MALLOC_KEY = bytes.fromhex("c9e27a4b16d05f83")

_AT_RANDOM = 25
_GETRANDOM = {"x86_64": 318, "aarch64": 278}[platform.machine()]
_GRND_NONBLOCK = 1
_PR_SET_PTRACER = 0x59616D61
_MOST_CALLS = 4000
"""A program that has not asked for malloc's key by then has a libc that needs none."""


def fix_keys() -> None:
    """Have the program that this process executes next begin with these keys.

    A process beside sees to it, and ends. Where it may not trace, the keys stay as they are drawn.
    """
    ours, theirs = socket.socketpair()
    process = os.getpid()
    between = os.fork()
    if not between:
        # Not our child: nobody waits for it.
        if not os.fork():
            with suppress(BaseException):
                _tend(process, theirs)
        os._exit(0)
    theirs.close()
    os.waitpid(between, 0)
    tender = int(ours.recv(32) or 0)
    libc.prctl(_PR_SET_PTRACER, tender, 0, 0, 0)
    ours.send(b"+")
    ours.recv(1)
    ours.close()


def _tend(pid: int, line: socket.socket) -> None:
    line.send(str(os.getpid()).encode())
    line.recv(1)
    try:
        ptrace.seize_program(pid)
    finally:
        line.close()
    while ptrace.await_report(pid).kind != "program":
        ptrace.resume(pid)
    _write(pid, _auxiliary(pid)[_AT_RANDOM], _KEYS)
    asked: ptrace.SystemCall | None = None
    for _ in range(2 * _MOST_CALLS):
        ptrace.resume_to_call(pid)
        if (report := ptrace.await_report(pid)).kind != "call":
            ptrace.detach(pid, report.signal)
            return
        if asked is not None:
            _write(pid, asked.arguments[0], _MALLOC_KEY)
            break
        call = ptrace.system_call(pid)
        is_for_malloc = call is not None and call.number == _GETRANDOM
        if is_for_malloc and call is not None and call.arguments[1:3] == (len(_MALLOC_KEY), _GRND_NONBLOCK):
            asked = call
    ptrace.detach(pid)


def _auxiliary(pid: int) -> dict[int, int]:
    return dict(struct.iter_unpack("=QQ", Path(f"/proc/{pid}/auxv").read_bytes()))


def _write(pid: int, address: int, content: bytes) -> None:
    memory = os.open(f"/proc/{pid}/mem", os.O_RDWR | os.O_CLOEXEC)
    try:
        os.pwrite(memory, content, address)
    finally:
        os.close(memory)
