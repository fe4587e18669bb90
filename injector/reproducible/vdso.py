"""Clocks that are read by system calls, so that how a program runs does not depend on when it runs.

The kernel lends every process code that reads the clocks (vdso(7)). It goes round again if the kernel sets
them meanwhile, some hundred times a second, or if a second is full: it executes more instructions then. A
process that is stepped or stopped amid it meets that often. A system call is always one instruction.
"""

from __future__ import annotations

import ctypes
import os
import platform

_NUMBERS = {
    "__vdso_clock_gettime": 228,
    "__vdso_clock_getres": 229,
    "__vdso_gettimeofday": 96,
    "__vdso_time": 201,
    "__vdso_getcpu": 309,
}
"""The system call behind each function (Linux arch/x86/entry/syscalls/syscall_64.tbl)."""


def clocks_by_system_calls() -> None:
    """Replace those functions, in this process and in what it forks. Elsewhere than on x86-64: nothing.

    :raises OSError: if the kernel lends none, or they cannot be replaced.
    """
    if platform.machine() != "x86_64":
        return
    lent = ctypes.CDLL("linux-vdso.so.1")
    for name, number in _NUMBERS.items():
        address = ctypes.cast(getattr(lent, name), ctypes.c_void_p).value or 0
        replace_code(
            address, b"\xb8" + number.to_bytes(4, "little") + b"\x0f\x05\xc3"
        )  # mov eax, number; syscall; ret


def replace_code(address: int, code: bytes) -> bytes:
    """Replace code of this process while it runs, and return what was there. x86-64 only.

    It is read back. A page of a file that is shared with other processes becomes a copy of our own.

    :raises OSError: if it is not there then.
    """
    before = ctypes.string_at(address, len(code))
    memory = os.open("/proc/self/mem", os.O_RDWR | os.O_CLOEXEC)
    try:
        os.pwrite(memory, code, address)
    finally:
        os.close(memory)
    if ctypes.string_at(address, len(code)) != code:
        message = f"the code at {address:#x} could not be replaced"
        raise OSError(message)
    return before
