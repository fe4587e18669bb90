"""A signal to ourselves every few milliseconds, which does nothing but end a system call that waits.

So a wait that the kernel gives no time limit, as waitpid(2) for one tracee, has one nevertheless. Sources:
timer_create(2), signal(7), Python's C API (PyOS_setsig: a handler after which calls are not restarted).
"""

from __future__ import annotations

import ctypes
import os
import signal
import struct
import threading

BEAT_NS = 10_000_000

_SIGNAL = signal.SIGRTMAX
_MONOTONIC, _TO_THREAD = 1, 4  # CLOCK_MONOTONIC, SIGEV_THREAD_ID
_SIGEVENT, _SIGEVENT_SIZE = struct.Struct("=Qiii"), 64  # value, signal, how, thread
_ITIMERSPEC = struct.Struct("=qqqq")  # interval, first: seconds and nanoseconds

_libc = ctypes.PyDLL(None, use_errno=True)
_libc.timer_create.argtypes = [ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p]
_libc.timer_settime.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p]
_libc.timer_delete.argtypes = [ctypes.c_void_p]
_set_handler = ctypes.pythonapi.PyOS_setsig
_set_handler.argtypes, _set_handler.restype = [ctypes.c_int, ctypes.c_void_p], ctypes.c_void_p
_NOTHING = ctypes.cast(_libc.getpid, ctypes.c_void_p)  # a handler must be safe at any moment


class Heartbeat:
    """Beats for the thread that starts it, until it is stopped."""

    def __init__(self) -> None:
        """Start it.

        :raises OSError: if the kernel gives us no timer.
        """
        _set_handler(_SIGNAL, _NOTHING)
        self._timer = ctypes.c_void_p()
        told = _SIGEVENT.pack(0, _SIGNAL, _TO_THREAD, threading.get_native_id()).ljust(_SIGEVENT_SIZE, b"\0")
        if _libc.timer_create(_MONOTONIC, told, ctypes.addressof(self._timer)):
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        _libc.timer_settime(self._timer, 0, _ITIMERSPEC.pack(0, BEAT_NS, 0, BEAT_NS), None)

    def stop(self) -> None:
        """Beat no more."""
        _libc.timer_delete(self._timer)
