"""Functions of the C library that give the same answer in every process, whoever started it and where.

``getrandom``: modules draw the keys of their hash tables with it as they are imported; in which order such
a table is gone through decides where what is made of it comes to lie. ``sched_getaffinity``: OpenBLAS and
others reserve memory for as many processors as they may use.
"""

from __future__ import annotations

import ctypes
import platform

from injector.reproducible.vdso import replace_code
from services.system.libc import libc

_FIXED = {
    # endbr64; mov rcx,rsi; mov al,5a; rep stosb; mov rax,rsi; ret: a buffer full of 5a
    "getrandom": "f30f1efa 4889f1 b05a f3aa 4889f0 c3",
    # endbr64; mov rdi,rdx; mov rcx,rsi; xor eax,eax; rep stosb; mov byte [rdx],1; ret: the first processor
    "sched_getaffinity": "f30f1efa 4889d7 4889f1 31c0 f3aa c60201 c3",
}
"""x86-64 code by function."""


class FixedLibc:
    """Those functions of this process's C library, replaced; elsewhere than on x86-64: nothing."""

    def __init__(self) -> None:
        self._addresses = {
            name: ctypes.cast(getattr(libc, name), ctypes.c_void_p).value or 0 for name in _FIXED
        }
        self._own: dict[str, bytes] = {}

    def begin(self) -> None:
        """From now on, in this process and in what it forks.

        :raises OSError: if the code cannot be replaced.
        """
        if platform.machine() == "x86_64":
            for name, address in self._addresses.items():
                self._own[name] = replace_code(address, bytes.fromhex(_FIXED[name]))

    def end(self) -> None:
        """Ask the kernel again; nothing happens if this process always has."""
        while self._own:
            name, code = self._own.popitem()
            replace_code(self._addresses[name], code)


FIXED_LIBC = FixedLibc()
"""That of this process: processes of :mod:`injector.reproducible.launch` begin with it."""
