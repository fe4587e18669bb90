"""ptrace(2) through ctypes: typed calls, typed reports, and waits that always end.

Every call about a tracee must come from the operating system thread that seized it.
Sources: ptrace(2), Linux include/uapi/linux/ptrace.h and asm-generic/siginfo.h.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import signal
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, TypeVar

_CONT, _SINGLESTEP, _DETACH = 7, 9, 17
_SEIZE, _INTERRUPT, _LISTEN = 0x4206, 0x4207, 0x4208
_GETEVENTMSG, _GETSIGINFO, _PEEKSIGINFO = 0x4201, 0x4202, 0x4209
_GETREGSET, _SETREGSET = 0x4204, 0x4205
_WORD = struct.Struct("=Q")
_GENERAL_SIZE = 512
_PROGRAM_COUNTER_AT = {"x86_64": 128, "aarch64": 256}[platform.machine()]  # in NT_PRSTATUS
_STOPPED_AT_TRAP = signal.SIGTRAP << 8 | 0x7F
_O_TRACEFORK, _O_TRACECLONE = 0x2, 0x8
_WALL = 0x40000000
_EVENT_FORK, _EVENT_CLONE, _EVENT_STOP = 1, 3, 128
_SIGINFO_SIZE = 128
_QUEUE = 64  # real-time signals aside, a signal is queued at most once
_STOP_SIGNALS = frozenset({signal.SIGSTOP, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU})

NT_PRSTATUS, NT_X86_XSTATE = 1, 0x202
"""Register sets: general registers, and the extended state in XSAVE's standard format."""

_TRAP_BRKPT, _TRAP_TRACE, _TRAP_PERF = 1, 2, 6
_OUR_TRAPS: dict[int, Kind] = {_TRAP_BRKPT: "step", _TRAP_TRACE: "step", _TRAP_PERF: "timer"}

SPIN_NS = 200_000
"""How long a wait polls before it sleeps: a single step takes 20 us, waking from sleep 15 us more."""

_SLICE_S = 0.001
"""Longest sleep of a wait: another thread of ours may have taken the SIGCHLD that was to end it."""

REMEDY = (
    "run the injector as the user of its targets, let them name it with PR_SET_PTRACER or set "
    "/proc/sys/kernel/yama/ptrace_scope to 0, or give it CAP_SYS_PTRACE; in a container: --cap-add SYS_PTRACE"
)

T = TypeVar("T")
Kind = Literal[
    "gone", "interrupted", "group_stop", "new_thread", "new_process", "step", "timer", "gate", "signal"
]

_libc = ctypes.CDLL(None, use_errno=True)
_ptrace = _libc.ptrace
_ptrace.restype = ctypes.c_long
_ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]


class PtraceError(Exception):
    """ptrace refused or failed: one line that says what and why."""


class GoneError(PtraceError):
    """There is no such thread, or it is being killed, or it does not stand where the call needs it."""


class NotPermittedError(PtraceError):
    """The kernel does not let us trace the process."""


@dataclass(frozen=True, slots=True)
class Report:
    """What a tracee reports: why it stands, or that it is gone.

    ``interrupted`` by :func:`interrupt` or newly attached; ``group_stop`` by a stop signal, of which
    the whole process stands; ``new_thread`` after a clone, ``new_process`` after a fork; ``step`` and
    ``timer`` are our own traps; ``gate`` is the signal by which a node marks where an armed call begins
    and ends (only :class:`injector.freeze.Tracees` knows which); ``signal`` is about to be delivered
    unless the tracee is resumed without it.
    """

    kind: Kind
    signal: int = 0


def _call(request: int, tid: int, address: int = 0, data: int = 0) -> int:
    result = int(_ptrace(request, tid, address, data))
    if result >= 0:
        return result
    number = ctypes.get_errno()
    if number == errno.ESRCH:
        message = f"no thread {tid} that is traced by us and stands"
        raise GoneError(message)
    if number == errno.EPERM:
        message = f"not permitted to trace thread {tid}: {REMEDY}"
        raise NotPermittedError(message)
    message = f"ptrace request {request:#x} on thread {tid}: {os.strerror(number)}"
    raise PtraceError(message)


def seize(tid: int, *, forks: bool = False) -> None:
    """Trace a thread without stopping it; threads that it starts are traced from their first instruction.

    With ``forks``, so are the processes that it forks.
    """
    _call(_SEIZE, tid, data=_O_TRACECLONE | (_O_TRACEFORK if forks else 0))


def interrupt(tid: int) -> None:
    """Ask a tracee to stop; it reports when it stands."""
    _call(_INTERRUPT, tid)


def resume(tid: int, signal_number: int = 0) -> None:
    """Let a tracee run, with a signal delivered first if one is given."""
    _call(_CONT, tid, data=signal_number)


def listen(tid: int) -> None:
    """Leave a tracee in its group-stop but let it hear of the signal that ends it."""
    _call(_LISTEN, tid)


def step(tid: int) -> None:
    """Let a tracee execute one instruction; it reports when it stands again."""
    _call(_SINGLESTEP, tid)


def detach(tid: int, signal_number: int = 0) -> None:
    """Let a tracee run untraced, with a signal delivered first if one is given."""
    _call(_DETACH, tid, data=signal_number)


def started(tid: int) -> int:
    """What a tracee has started, after a report of kind ``new_thread`` or ``new_process``."""
    value = ctypes.c_ulong()
    _call(_GETEVENTMSG, tid, data=ctypes.addressof(value))
    return value.value


def send(pid: int, tid: int, signal_number: int) -> None:
    """Send a signal to one thread; nothing happens if it is gone."""
    _libc.tgkill(pid, tid, signal_number)


def timer_trap_pending(tid: int) -> bool:
    """Whether a timer's trap is queued for a standing tracee, which would kill it once untraced."""
    arguments = (ctypes.c_uint32 * 4)(0, 0, 0, _QUEUE)  # struct { u64 offset; u32 flags; s32 count }
    queued = ctypes.create_string_buffer(_QUEUE * _SIGINFO_SIZE)
    count = _call(_PEEKSIGINFO, tid, ctypes.addressof(arguments), ctypes.addressof(queued))
    return any(_is_timer(queued.raw[at * _SIGINFO_SIZE :]) for at in range(count))


def _is_timer(siginfo: bytes) -> bool:
    number = int.from_bytes(siginfo[0:4], "little")
    code = int.from_bytes(siginfo[8:12], "little", signed=True)
    return (number, code) == (signal.SIGTRAP, _TRAP_PERF)


def read_registers(tid: int, kind: int, size: int) -> bytearray:
    """A register set of a standing tracee, as long as the kernel makes it (at most ``size`` bytes)."""
    content = bytearray(size)
    length = _registers(_GETREGSET, tid, kind, content)
    return content[:length]


def write_registers(tid: int, kind: int, content: bytearray) -> None:
    """Replace a register set of a standing tracee."""
    _registers(_SETREGSET, tid, kind, content)


def _registers(request: int, tid: int, kind: int, content: bytearray) -> int:
    start = ctypes.addressof(ctypes.c_char.from_buffer(content))
    vector = (ctypes.c_size_t * 2)(start, len(content))  # struct iovec
    _call(request, tid, kind, ctypes.addressof(vector))
    return vector[1]


def trace(tid: int, most: int) -> tuple[list[int], Report | None]:
    """Let a standing tracee execute up to ``most`` instructions: where each lies, and what ended them early.

    Waits for each without end: only for a tracee that somebody kills if it hangs.
    """
    registers = bytearray(_GENERAL_SIZE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(registers))
    vector = (ctypes.c_size_t * 2)(start, len(registers))  # struct iovec
    at_vector = ctypes.addressof(vector)
    addresses: list[int] = []
    for _ in range(most):
        with suppress(GoneError):  # killed; its end is reported next
            _call(_GETREGSET, tid, NT_PRSTATUS, at_vector)
            addresses.append(_WORD.unpack_from(registers, _PROGRAM_COUNTER_AT)[0])
            _call(_SINGLESTEP, tid)
        _, status = os.waitpid(tid, _WALL)
        if status != _STOPPED_AT_TRAP:
            return addresses, _report(tid, status)
    return addresses, None


def poll(tid: int) -> Report | None:
    """What a tracee has to report, if anything; it then stands (or is gone)."""
    try:
        reported, status = os.waitpid(tid, os.WNOHANG | _WALL)
    except ChildProcessError:
        return Report("gone")
    return _report(tid, status) if reported else None


def _report(tid: int, status: int) -> Report:
    """What the status of a wait tells."""
    if not os.WIFSTOPPED(status):
        return Report("gone", os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0)
    number, event = os.WSTOPSIG(status), status >> 16
    if event == _EVENT_STOP:
        return Report("group_stop" if number in _STOP_SIGNALS else "interrupted", number)
    if event == _EVENT_CLONE:
        return Report("new_thread")
    if event == _EVENT_FORK:
        return Report("new_process")
    return _signal_report(tid, number)


def _signal_report(tid: int, number: int) -> Report:
    if number != signal.SIGTRAP:
        return Report("signal", number)
    siginfo = ctypes.create_string_buffer(_SIGINFO_SIZE)
    try:
        _call(_GETSIGINFO, tid, data=ctypes.addressof(siginfo))
    except GoneError:  # killed meanwhile; its end is reported next
        return Report("signal", number)
    code = int.from_bytes(siginfo.raw[8:12], "little", signed=True)
    kind = _OUR_TRAPS.get(code)
    return Report("signal", number) if kind is None else Report(kind)


def hear_of_children() -> set[signal.Signals]:
    """Hold SIGCHLD back in this thread, so that :func:`wait_until` can sleep on it; the mask before."""
    return set(signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCHLD}))  # type: ignore[arg-type]


def wait_until(look: Callable[[], T | None], limit_s: float) -> T | None:
    """Call ``look`` until it finds something; None after ``limit_s``.

    Polls for :data:`SPIN_NS`, then sleeps until a tracee reports.
    """
    begin = time.monotonic_ns()
    while True:
        found = look()
        if found is not None:
            return found
        waited_ns = time.monotonic_ns() - begin
        if waited_ns >= limit_s * 1e9:
            return None
        if waited_ns > SPIN_NS:
            signal.sigtimedwait({signal.SIGCHLD}, _SLICE_S)
        else:
            os.sched_yield()  # tracees on our own processor need it to get anywhere
