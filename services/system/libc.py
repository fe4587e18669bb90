"""The C library through ctypes: loaded here and nowhere else.

What numba's compiled loops call is in :mod:`services.system.c_library`. That module imports numba, which
processes that are about to execute another program need not have.
"""

from __future__ import annotations

import ctypes
import os

libc = ctypes.CDLL(None, use_errno=True)
"""Functions that may wait: other threads of the interpreter run meanwhile."""

libc_with_gil = ctypes.PyDLL(None, use_errno=True)
"""Functions that return at once: the interpreter's lock is kept, so that no other thread gets in between."""


_ADDR_NO_RANDOMIZE, _ASK = 0x0040000, 0xFFFFFFFF


def turn_address_randomisation_off() -> None:
    """Have every program that this process or a fork of it executes find its memory at the same addresses."""
    libc.personality(libc.personality(_ASK) | _ADDR_NO_RANDOMIZE)


def checked(answer: int) -> int:
    """Return what a function of the C library answered.

    :raises OSError: by ``errno``, if the answer is -1.
    """
    if answer == -1:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return answer
