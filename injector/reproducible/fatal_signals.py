"""Handlers of the signals that end a node by a fault: they tell whether another process has sent one.

A node that dies of what it does itself is a result; one that somebody kills is none. A signal that the kernel
sends for an illegal access looks alike to who waits for the node, wherever it came from. The node itself is
told, so its handler passes that on before it lets the signal end it.

A node also survives the traps that a killed injector leaves behind: while it is in a single step, or just
before a timer's trap. Untraced it would die of that trap. The kernel itself ends single steps when it
delivers a signal. A breakpoint instruction that a fault leads to kills as ever.
"""

from __future__ import annotations

import ctypes
import os
import signal
from typing import Any

import numba

from services.system.libc import checked, libc

cfunc: Any = numba.cfunc
types: Any = numba.types
carray: Any = numba.carray  # type: ignore[attr-defined]

HANDLED = frozenset(
    {
        signal.SIGSEGV,
        signal.SIGBUS,
        signal.SIGILL,
        signal.SIGFPE,
        signal.SIGTRAP,
        signal.SIGABRT,
        signal.SIGSYS,
    }
)
"""What the kernel sends to who does something illegal, and what a process aborts by."""

_OWN = HANDLED | {signal.SIGPIPE, signal.SIGALRM}
"""By these a process can end without anybody else's doing."""

_ORIGIN = 116
"""The node's descriptor of the pipe on which its handler tells that another process has sent a signal."""

_TRAP_TRACE, _TRAP_PERF = 2, 6
_TRAP = int(signal.SIGTRAP)
_DEFAULT = 0
_SA_SIGINFO, _SA_RESTART = 0x4, 0x10000000

_raise_signal = types.ExternalFunction("raise", types.int32(types.int32))
_set_handler = types.ExternalFunction("signal", types.intp(types.int32, types.intp))
_getpid = types.ExternalFunction("getpid", types.int32())
_write = types.ExternalFunction("write", types.intp(types.int32, types.CPointer(types.int32), types.intp))


@cfunc(
    types.void(types.int32, types.CPointer(types.int32), types.voidptr), nopython=True, cache=True, nogil=True
)
def _on_fatal_signal(number, siginfo, _):  # type: ignore[no-untyped-def] # pragma: no cover - compiled
    info = carray(siginfo, 5)
    code, sender = info[2], info[4]
    if number == _TRAP and code in (_TRAP_TRACE, _TRAP_PERF):
        return
    if code <= 0 and sender != _getpid():  # sent by a process, see sigaction(2)
        _write(_ORIGIN, siginfo, 1)
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


def handle_fatal_signals(origin: int) -> None:
    """Install the handlers in this process and its forks; ``origin`` is a pipe's end, taken over."""
    os.dup2(origin, _ORIGIN)
    os.close(origin)
    action = _Action(handler=_on_fatal_signal.address, flags=_SA_SIGINFO | _SA_RESTART)
    for number in sorted(HANDLED):
        checked(libc.sigaction(int(number), ctypes.byref(action), None))


def ended_by_another(status: int, origin: int) -> bool:
    """Whether another process has ended one that handles fatal signals, which is no result.

    ``status`` is that of :func:`os.waitstatus_to_exitcode`, ``origin`` the other end of its pipe.
    """
    if status >= 0:
        return False
    if -status not in _OWN:
        return True
    os.set_blocking(origin, False)
    try:
        return bool(os.read(origin, 1))
    except BlockingIOError:  # forks of it are left, with the pipe
        return False
