"""Stopping a thread at a moment: after some processor time of its own, or at a pass through an address.

A perf event counts in the kernel and raises SIGTRAP in the thread, which ptrace shows to us only; or,
where a ``notice`` is given, that signal, which a thread that we do not trace any more survives.
Source: perf_event_open(2), fcntl(2), Linux include/uapi/linux/perf_event.h.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import struct
from collections.abc import Callable
from typing import Literal

from injector.tracing.ptrace import GoneError
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from injector.tracing.waiting import wait_until
from services.system.libc import libc

SHORTEST_NS = 10_000
"""The kernel's timer takes no shorter period."""

CHANCES_NS = (0, 20_000, 50_000, 100_000, 200_000, 400_000, 800_000)
"""Thread time after the moment at which the trap is tried: the kernel drops it while in kernel mode."""

RETRY_NS = 250_000
"""Thread time between later tries. With much less, a loaded machine does nothing but serve the timer."""

GRACE_NS = 1_000_000
"""Thread time after the moment at which a trap that has not come is not going to."""

REMEDY = (
    "set /proc/sys/kernel/perf_event_paranoid to 2 or lower, or give the injector CAP_PERFMON; "
    "in a container: --cap-add PERFMON and a seccomp profile that allows perf_event_open"
)

_PERF_EVENT_OPEN = 298  # the number of the system call on x86-64
_TYPE_SOFTWARE, _COUNT_TASK_CLOCK = 1, 1
_TYPE_BREAKPOINT, _EXECUTE, _LONG = 5, 4, 8
_ATTR_SIZE = 128  # PERF_ATTR_SIZE_VER7, the first with sig_data
_DISABLED, _EXCLUDE_KERNEL, _EXCLUDE_HV = 1 << 0, 1 << 5, 1 << 6
_REMOVE_ON_EXEC, _SIGTRAP = 1 << 36, 1 << 37
_FLAG_CLOEXEC = 8
_IOC_ENABLE, _IOC_DISABLE, _IOC_REFRESH = 0x2400, 0x2401, 0x2402
_IOC_PERIOD, _IOC_MODIFY = 0x40082404, 0x4008240B
_F_SETOWN_EX, _OWNER_THREAD = 15, 0


class TriggerError(Exception):
    """The kernel gives us no timer on the thread: one line that says why and what to do."""


class ThreadTimer:
    """A trap for a traced thread after ``cpu_ns`` of its own time from now, once.

    Time in the kernel counts, but the trap comes only in user mode. To be used within ``with``,
    inside that of :class:`injector.tracing.tracees.TraceeGroup`: the timer must be gone before the thread is
    untraced.
    """

    def __init__(self, thread: Tracee, cpu_ns: int, notice: int = 0) -> None:
        """Start the timer on a traced thread.

        :raises TriggerError: if the kernel refuses.
        :raises GoneError: if the thread has ended.
        """
        self._moment_ns = max(cpu_ns, SHORTEST_NS)
        self._insisted = False
        self._descriptors: list[int] = []
        thread.timed = True
        try:
            for chance_ns in CHANCES_NS:
                descriptor = _timer(thread.tid, self._moment_ns + chance_ns, notice)
                self._descriptors.append(descriptor)
                _give(descriptor, thread.tid, notice)
                # Enables it for one overflow, after which the kernel disables it.
                fcntl.ioctl(descriptor, _IOC_REFRESH, 1)
        except BaseException:
            self.close()
            raise

    @property
    def spent_ns(self) -> int:
        """Thread time since the start, in the kernel too."""
        return int.from_bytes(os.read(self._descriptors[0], 8), "little")

    def insist(self) -> None:
        """Once no chance is left, have it tried again and again until the trap comes."""
        if not self._insisted and self.spent_ns > self._moment_ns + GRACE_NS:
            self._insisted = True
            fcntl.ioctl(self._descriptors[0], _IOC_PERIOD, struct.pack("=Q", RETRY_NS))

    def close(self) -> None:
        """Close the timer, whether its trap came or not; a trap may still be under way."""
        for descriptor in self._descriptors:
            os.close(descriptor)

    def __enter__(self) -> ThreadTimer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Breakpoint:
    """Counts a traced thread's passes through an address, and traps it at the ``hit``-th (0: never).

    With a ``notice`` it traps it at every ``hit``-th.

    It then stands at the instruction there, not yet executed. Nothing is written into the process. To be
    used like :class:`ThreadTimer`.
    """

    def __init__(
        self, thread: Tracee, address: int, hit: int = 0, notice: int = 0, *, held_back: bool = False
    ) -> None:
        """Begin to count; one that is ``held_back`` begins when it is aimed.

        :raises TriggerError: if the kernel refuses.
        :raises GoneError: if the thread has ended.
        """
        thread.timed = thread.timed or hit > 0 or held_back
        self._descriptor = _breakpoint(thread.tid, address, int(held_back) or hit, notice)
        _give(self._descriptor, thread.tid, notice)
        if held_back:
            return
        if hit and not notice:
            fcntl.ioctl(self._descriptor, _IOC_REFRESH, 1)
        else:
            fcntl.ioctl(self._descriptor, _IOC_ENABLE, 0)

    @property
    def hits(self) -> int:
        """How many passes were counted so far."""
        return int.from_bytes(os.read(self._descriptor, 8), "little")

    def aim(self, hit: int) -> None:
        """Count on, and trap at the ``hit``-th pass from now on; of one that is held back."""
        fcntl.ioctl(self._descriptor, _IOC_PERIOD, struct.pack("=Q", hit))
        fcntl.ioctl(self._descriptor, _IOC_ENABLE, 0)

    def hold_back(self) -> None:
        """Stop counting until :meth:`aim` is called."""
        fcntl.ioctl(self._descriptor, _IOC_DISABLE, 0)

    def close(self) -> None:
        """Close the breakpoint; a trap may still be under way."""
        os.close(self._descriptor)

    def __enter__(self) -> Breakpoint:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class StepBreakpoint:
    """A breakpoint that is moved before each step of a traced thread, or away."""

    def __init__(self, thread: Tracee, notice: int) -> None:
        """Open a breakpoint that is disabled until it is moved to an address.

        :raises TriggerError, GoneError: as :class:`Breakpoint` does.
        """
        self._notice, self._away = notice, True
        self._descriptor = _breakpoint(thread.tid, 0, 1, notice)
        _give(self._descriptor, thread.tid, notice)

    def move(self, address: int | None) -> None:
        """Move the breakpoint to an address, or disable it."""
        if address is None and self._away:
            return
        self._away = address is None
        attributes = bytearray(_breakpoint_attributes(address or 0, 1, self._notice, disabled=self._away))
        fcntl.ioctl(self._descriptor, _IOC_MODIFY, attributes)

    def close(self) -> None:
        """Close the breakpoint; the thread is no longer trapped."""
        os.close(self._descriptor)


def _give(descriptor: int, tid: int, notice: int) -> None:
    """Have an event announced to a thread by a signal of our choice, with ``si_code`` POLL_HUP or POLL_IN.

    :raises GoneError: if the thread has ended.
    """
    if notice:
        try:
            fcntl.fcntl(descriptor, _F_SETOWN_EX, struct.pack("=ii", _OWNER_THREAD, tid))
        except ProcessLookupError as error:
            message = f"thread {tid} has ended"
            raise GoneError(message) from error
        fcntl.fcntl(descriptor, fcntl.F_SETSIG, notice)
        fcntl.fcntl(descriptor, fcntl.F_SETFL, os.O_ASYNC)


def _timer(tid: int, period_ns: int, notice: int) -> int:
    flags = _DISABLED | _EXCLUDE_KERNEL | _EXCLUDE_HV | _REMOVE_ON_EXEC | (0 if notice else _SIGTRAP)
    return _perf_event_open(
        tid,
        struct.pack("=IIQQQQQ", _TYPE_SOFTWARE, _ATTR_SIZE, _COUNT_TASK_CLOCK, period_ns, 0, 0, flags),
    )


def _breakpoint(tid: int, address: int, hit: int, notice: int) -> int:
    return _perf_event_open(tid, _breakpoint_attributes(address, hit, notice, disabled=True))


def _breakpoint_attributes(address: int, hit: int, notice: int, *, disabled: bool) -> bytes:
    flags = _EXCLUDE_KERNEL | _EXCLUDE_HV | (_DISABLED if disabled else 0)
    if hit:
        flags |= _REMOVE_ON_EXEC | (0 if notice else _SIGTRAP)
    head = struct.pack("=IIQQQQQ", _TYPE_BREAKPOINT, _ATTR_SIZE, 0, hit, 0, 0, flags)
    return (head + struct.pack("=IIQQ", 0, _EXECUTE, address, _LONG)).ljust(_ATTR_SIZE, b"\0")


def _perf_event_open(tid: int, attributes: bytes) -> int:
    buffer = ctypes.create_string_buffer(attributes, _ATTR_SIZE)
    descriptor = int(libc.syscall(_PERF_EVENT_OPEN, buffer, tid, -1, -1, ctypes.c_ulong(_FLAG_CLOEXEC)))
    if descriptor >= 0:
        return descriptor
    number = ctypes.get_errno()
    if number == errno.ESRCH:
        message = f"thread {tid} has ended"
        raise GoneError(message)
    remedy = {
        errno.EACCES: REMEDY,
        errno.EPERM: REMEDY,
        errno.ENOSYS: "perf events are not compiled into this kernel",
        errno.EINVAL: "traps by perf events need Linux 5.13 or newer",
        errno.E2BIG: "traps by perf events need Linux 5.13 or newer",
        errno.ENOSPC: "every breakpoint register is in use (a debugger?)",
    }.get(number, "")
    message = f"no perf event on thread {tid}: {os.strerror(number)}" + (f"; {remedy}" if remedy else "")
    raise TriggerError(message)


def await_trap(
    tracees: TraceeGroup,
    thread: Tracee,
    finished: Callable[[], bool],
    limit_s: float,
    insist: Callable[[], None] = lambda: None,
) -> Literal["trapped", "finished", "gone", "late"]:
    """Let everybody run until a trap, the thread's death, or the caller says that it is over."""

    def look() -> Literal["trapped", "finished", "gone"] | None:
        tracees.service()
        if thread.tid not in tracees.threads:
            return "gone"
        if thread.report is not None and thread.report.kind == "timer":
            return "trapped"
        if finished() or (thread.report is not None and thread.report.kind == "gate"):
            return "finished"
        insist()
        return None

    return wait_until(look, limit_s) or "late"
