"""The time in which all threads stand, and that no other process lengthens it.

Another process that takes our processor, or a node that we have just let go, would keep the rest standing for
the 4 ms of a time slice. Where the kernel grants it (CAP_SYS_NICE, or a limit RLIMIT_RTPRIO), our priority is
real-time from just before the first stop until after the last resume (sched(7)). A wait in it is for one
thread alone, and a :class:`Heartbeat` ends it. Sources: timer_create(2), signal(7), Python's C API
(PyOS_setsig: a handler after which calls are not restarted).
"""

from __future__ import annotations

import ctypes
import os
import signal
import struct
import threading
import time

from services.system.libc import checked, libc_with_gil

BEAT_NS = 10_000_000
"""Wall time between two of its signals."""

_LOWEST = 1
_SIGNAL = signal.SIGRTMAX
_MONOTONIC, _TO_THREAD = 1, 4  # CLOCK_MONOTONIC, SIGEV_THREAD_ID
_SIGEVENT, _SIGEVENT_SIZE = struct.Struct("=Qiii"), 64  # value, signal, how, thread
_ITIMERSPEC = struct.Struct("=qqqq")  # interval, first: seconds and nanoseconds

libc_with_gil.timer_create.argtypes = [ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p]
libc_with_gil.timer_settime.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p]
libc_with_gil.timer_delete.argtypes = [ctypes.c_void_p]
_set_handler = ctypes.pythonapi.PyOS_setsig
_set_handler.argtypes, _set_handler.restype = [ctypes.c_int, ctypes.c_void_p], ctypes.c_void_p
_NOTHING = ctypes.cast(libc_with_gil.getpid, ctypes.c_void_p)  # a handler must be safe at any moment


class Heartbeat:
    """A signal to the thread that starts it every few milliseconds, which does nothing but end a system call.

    So a wait that the kernel gives no time limit, as waitpid(2) for one tracee, has one nevertheless.
    """

    def __init__(self) -> None:
        """Start the timer for the calling thread.

        :raises OSError: if the kernel gives us no timer.
        """
        _set_handler(_SIGNAL, _NOTHING)
        self._timer = ctypes.c_void_p()
        told = _SIGEVENT.pack(0, _SIGNAL, _TO_THREAD, threading.get_native_id()).ljust(_SIGEVENT_SIZE, b"\0")
        checked(libc_with_gil.timer_create(_MONOTONIC, told, ctypes.addressof(self._timer)))
        libc_with_gil.timer_settime(self._timer, 0, _ITIMERSPEC.pack(0, BEAT_NS, 0, BEAT_NS), None)

    def stop(self) -> None:
        """Take the timer away: no more signals are sent."""
        libc_with_gil.timer_delete(self._timer)


class RealtimePause:
    """One pause after another; ``length_us`` is that of the last one."""

    def __init__(self) -> None:
        self.length_us = 0.0
        self._begin_ns = 0
        self._usual: tuple[int, os.sched_param] | None = None
        self._heartbeat: Heartbeat | None = None

    @property
    def under_way(self) -> bool:
        """Whether everybody stands, or is about to."""
        return self._begin_ns > 0

    @property
    def so_far_ns(self) -> int:
        """Length of the current pause up to now, ns."""
        return time.monotonic_ns() - self._begin_ns

    def begin(self) -> None:
        """The first is about to be stopped; nothing happens if a pause is under way.

        :raises OSError: if the kernel gives us no timer.
        """
        if self.under_way:
            return
        self._heartbeat = Heartbeat()
        usual = os.sched_getscheduler(0), os.sched_getparam(0)
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_LOWEST))
        except PermissionError:
            pass
        else:
            self._usual = usual
        self._begin_ns = time.monotonic_ns()

    def end(self) -> None:
        """The last one has been let go; nothing happens if no pause is under way."""
        if not self.under_way:
            return
        self.length_us = self.so_far_ns / 1e3
        self._begin_ns = 0
        if self._heartbeat is not None:
            self._heartbeat.stop()
        if self._usual is not None:
            os.sched_setscheduler(0, *self._usual)
            self._usual = None
