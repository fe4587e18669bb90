"""A handler for SIGTRAP, by which a node survives the traps that a killed injector leaves behind.

An injector that is killed while a node is in a single step, or just before a timer's trap, leaves that
trap behind, and untraced the node would die of it. With a handler it goes on: the kernel itself ends
single steps when it delivers a signal. A breakpoint instruction that a fault leads to kills as ever.
"""

from __future__ import annotations

import ctypes
import signal
from typing import Any

import numba

from services.system.libc import checked, libc

cfunc: Any = numba.cfunc
types: Any = numba.types
carray: Any = numba.carray  # type: ignore[attr-defined]

_TRAP_TRACE, _TRAP_PERF = 2, 6
_DEFAULT = 0
_SA_SIGINFO, _SA_RESTART = 0x4, 0x10000000

_raise_signal = types.ExternalFunction("raise", types.int32(types.int32))
_set_handler = types.ExternalFunction("signal", types.intp(types.int32, types.intp))


@cfunc(
    types.void(types.int32, types.CPointer(types.int32), types.voidptr), nopython=True, cache=True, nogil=True
)
def _on_trap(number, siginfo, _):  # type: ignore[no-untyped-def] # pragma: no cover - compiled
    code = carray(siginfo, 3)[2]
    if code not in (_TRAP_TRACE, _TRAP_PERF):
        _set_handler(number, _DEFAULT)
        _raise_signal(number)


class _Action(ctypes.Structure):
    """``struct sigaction`` of the C library."""

    _fields_ = (
        ("handler", ctypes.c_void_p),
        ("mask", ctypes.c_ulong * 16),
        ("flags", ctypes.c_int),
        ("restorer", ctypes.c_void_p),
    )


def guard_against_traps() -> None:
    """Install the handler: this process and its forks survive single-step and timer traps untraced."""
    action = _Action(handler=_on_trap.address, flags=_SA_SIGINFO | _SA_RESTART)
    checked(libc.sigaction(int(signal.SIGTRAP), ctypes.byref(action), None))
