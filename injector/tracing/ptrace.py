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
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, NamedTuple

from services.system.libc import libc_with_gil

_PEEKUSER, _POKEUSER, _CONT, _SINGLESTEP, _DETACH, _SYSCALL = 3, 6, 7, 9, 17, 24
_SEIZE, _INTERRUPT, _LISTEN = 0x4206, 0x4207, 0x4208
_SETOPTIONS, _GETEVENTMSG, _GETSIGINFO, _PEEKSIGINFO = 0x4200, 0x4201, 0x4202, 0x4209
_GETREGSET, _SETREGSET, _GET_SYSCALL_INFO = 0x4204, 0x4205, 0x420E
_GETSIGMASK, _SETSIGMASK, _SIGSET_SIZE = 0x420A, 0x420B, 8
_WORD = struct.Struct("=Q")
_GENERAL_SIZE = 512
_PROGRAM_COUNTER_AT = {"x86_64": 128, "aarch64": 256}[platform.machine()]  # in NT_PRSTATUS
_STOPPED_AT_TRAP = signal.SIGTRAP << 8 | 0x7F
_O_TRACESYSGOOD, _O_TRACEFORK, _O_TRACEVFORK, _O_TRACECLONE, _O_TRACEEXEC = 0x1, 0x2, 0x4, 0x8, 0x10
_O_TRACEEXIT, _O_TRACESECCOMP, _O_EXITKILL = 0x40, 0x80, 0x100000
_WALL = 0x40000000
_EVENT_STOP = 128
_STOPPED_BY_INTERRUPT = _EVENT_STOP << 16 | _STOPPED_AT_TRAP
# PTRACE_EVENT_FORK, VFORK, CLONE, EXEC, EXIT and SECCOMP
_EVENTS: dict[int, Kind] = {1: "new_process", 2: "new_process", 3: "new_thread", 4: "program"}
_EVENTS |= {6: "exits", 7: "filtered"}
_STOPPED_AT_CALL = signal.SIGTRAP | 0x80
_CALL_INFO = struct.Struct("=B3xIQQ7Q")  # which end, architecture, where it is, stack; number, arguments
_ENTERED = 1
_32_BIT = 0x40000003  # AUDIT_ARCH_I386
_SIGINFO_SIZE = 128
_QUEUE = 64  # real-time signals aside, a signal is queued at most once
_STOP_SIGNALS = frozenset({signal.SIGSTOP, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU})

NT_PRSTATUS, NT_X86_XSTATE = 1, 0x202
"""Register sets: general registers, and the extended state in XSAVE's standard format."""

_SENT = (0, -1, -6)  # SI_USER, SI_QUEUE, SI_TKILL
_TRAP_BRKPT, _TRAP_TRACE, _TRAP_PERF = 1, 2, 6
_TRAP_HANDLER = 5  # a tracee that was stepped into the handler of a signal
_OUR_TRAPS: dict[int, Kind] = dict.fromkeys((_TRAP_BRKPT, _TRAP_TRACE, _TRAP_HANDLER), "step")
_OUR_TRAPS[_TRAP_PERF] = "timer"

REMEDY = (
    "run the injector as the user of its targets, let them name it with PR_SET_PTRACER or set "
    "/proc/sys/kernel/yama/ptrace_scope to 0, or give it CAP_SYS_PTRACE; in a container: --cap-add SYS_PTRACE"
)

Kind = Literal[
    "gone",
    "interrupted",
    "group_stop",
    "new_thread",
    "new_process",
    "program",
    "call",
    "filtered",
    "exits",
    "step",
    "timer",
    "gate",
    "signal",
]

# These calls never wait, but for a tracee in a pause. With the interpreter's lock let go of, another thread
# of ours could take it and then be kept from running, and we with it.
_ptrace = libc_with_gil.ptrace
_ptrace.restype = ctypes.c_long
_ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
_waitpid = libc_with_gil.waitpid
_waitpid.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_int]


class PtraceError(Exception):
    """ptrace refused or failed: one line that says what and why."""


class GoneError(PtraceError):
    """There is no such thread, or it is being killed, or it does not stand where the call needs it."""


class NotPermittedError(PtraceError):
    """The kernel does not let us trace the process."""


@dataclass(frozen=True, slots=True)
class StopReport:
    """What a tracee reports: why it stands, or that it is gone.

    ``interrupted`` by :func:`interrupt` or newly attached; ``group_stop`` by a stop signal, of which
    the whole process stands; ``new_thread`` after a clone, ``new_process`` after a fork, ``program`` after an
    exec; ``call`` before or after a call of the kernel, ``filtered`` before one that a seccomp filter
    tells of; ``exits`` about to end; ``step`` and ``timer`` are our own traps; ``gate`` is the signal by
    which a node marks where an armed call begins and ends (only
    :class:`injector.tracing.tracees.TraceeGroup` knows which); ``signal`` is about to be delivered unless the
    tracee is resumed without it. One that is ``gone`` ended by the ``signal`` or,
    without one, with the ``exit_status``.
    """

    kind: Kind
    signal: int = 0
    exit_status: int = 0


_INTERRUPTED = StopReport("interrupted", signal.SIGTRAP)


class SystemCall(NamedTuple):
    """A call of the kernel that a tracee is about to make.

    ``native``: by the 64-bit table of numbers, not by that of 32-bit programs, which ``int 0x80`` uses.
    """

    number: int
    arguments: tuple[int, ...]
    native: bool


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


def seize(tid: int, *, forks: bool = False, ours: bool = False) -> None:
    """Trace a thread without stopping it; threads that it starts are traced from their first instruction.

    With ``forks``, so are the processes that it forks; what is ``ours`` dies with us.
    """
    _call(_SEIZE, tid, data=_O_TRACECLONE | (_O_TRACEFORK if forks else 0) | (_O_EXITKILL if ours else 0))


def seize_program(tid: int) -> None:
    """Trace a process that is about to execute another program, and what that asks of the kernel."""
    _call(_SEIZE, tid, data=_O_TRACEEXEC | _O_TRACESYSGOOD)


def seize_launched(tid: int, *, exits: bool = False) -> None:
    """Trace a process that is about to execute a program, and all that this starts; it dies with us.

    With ``exits``, threads report when they are about to end.
    """
    started = _O_TRACEFORK | _O_TRACEVFORK | _O_TRACECLONE | (_O_TRACEEXIT if exits else 0)
    _call(_SEIZE, tid, data=started | _O_TRACEEXEC | _O_TRACESECCOMP | _O_EXITKILL)


def die_with_us(tid: int) -> None:
    """Have a standing tracee die with us, and report calls of the kernel; what it starts is not traced."""
    _call(_SETOPTIONS, tid, data=_O_EXITKILL | _O_TRACESYSGOOD)


def resume_to_call(tid: int, signal_number: int = 0) -> None:
    """Let a tracee run to the beginning or the end of a call of the kernel, where it reports."""
    _call(_SYSCALL, tid, data=signal_number)


def system_call(tid: int) -> SystemCall | None:
    """The call that a tracee stands before; None if it stands after one."""
    told = ctypes.create_string_buffer(_CALL_INFO.size)
    _call(_GET_SYSCALL_INFO, tid, _CALL_INFO.size, ctypes.addressof(told))
    end, architecture, _, _, number, *arguments = _CALL_INFO.unpack(told.raw)
    if end != _ENTERED:
        return None
    return SystemCall(number, tuple(arguments), native=architecture != _32_BIT)


def interrupt(tid: int) -> None:
    """Ask a tracee to stop; it reports when it stands."""
    _call(_INTERRUPT, tid)


def resume(tid: int, signal_number: int = 0) -> None:
    """Let a tracee run, with a signal delivered first if one is given."""
    _call(_CONT, tid, data=signal_number)


def listen(tid: int) -> None:
    """Leave a tracee in its group-stop but let it hear of the signal that ends it."""
    _call(_LISTEN, tid)


def step(tid: int, signal_number: int = 0) -> None:
    """Let a tracee execute one instruction, or get a signal; it reports when it stands again."""
    _call(_SINGLESTEP, tid, data=signal_number)


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
    libc_with_gil.tgkill(pid, tid, signal_number)


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


def blocked_signals(tid: int) -> int:
    """The signals that a standing tracee blocks: bit N - 1 is signal N."""
    mask = ctypes.c_uint64()
    _call(_GETSIGMASK, tid, _SIGSET_SIZE, ctypes.addressof(mask))
    return mask.value


def block_signals(tid: int, mask: int) -> None:
    """Have a standing tracee block these signals and no others; what is under way to it stays under way."""
    content = ctypes.c_uint64(mask)
    _call(_SETSIGMASK, tid, _SIGSET_SIZE, ctypes.addressof(content))


def trace(tid: int, most: int, until: int = 0) -> tuple[list[int], StopReport | None]:
    """Let a standing tracee execute up to ``most`` instructions: where each lies, and what ended them early.

    If it comes to stand at ``until``, that is the end, too.

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
            address = _WORD.unpack_from(registers, _PROGRAM_COUNTER_AT)[0]
            if address == until:
                return addresses, None
            addresses.append(address)
            _call(_SINGLESTEP, tid)
        _, status = os.waitpid(tid, _WALL)
        if status != _STOPPED_AT_TRAP:
            return addresses, _report(tid, status)
    return addresses, None


def walk(tid: int, most: int, until: Collection[int]) -> tuple[int, StopReport | None]:
    """Let a standing tracee execute up to ``most`` instructions, until it stands at one of ``until``.

    How many it executed, and what ended them early. Waits as :func:`trace` does. x86-64 only.
    """
    for taken in range(1, most + 1):
        with suppress(GoneError):
            _call(_SINGLESTEP, tid)
        _, status = os.waitpid(tid, _WALL)
        if status != _STOPPED_AT_TRAP:
            return taken, _report(tid, status)
        if program_counter(tid) in until:
            return taken, None
    return most, None


def program_counter(tid: int) -> int:
    """Address of the instruction that a standing tracee executes next. x86-64 only."""
    return _call(_PEEKUSER, tid, _PROGRAM_COUNTER_AT)


def go_to(tid: int, address: int) -> None:
    """Have a standing tracee go on at ``address``. x86-64 only."""
    _call(_POKEUSER, tid, _PROGRAM_COUNTER_AT, address)


def await_report(tid: int) -> StopReport:
    """Wait, without end, for what a tracee has to report."""
    return _report(tid, os.waitpid(tid, _WALL)[1])


def await_report_or_signal(tid: int) -> StopReport | None:
    """Wait for what a tracee has to report; None if a signal that we handle came first.

    Other tracees' reports do not wake us, as they do where SIGCHLD is waited for.
    """
    status = ctypes.c_int()
    if _waitpid(tid, ctypes.addressof(status), _WALL) == tid:
        return _report(tid, status.value)
    return None if ctypes.get_errno() == errno.EINTR else StopReport("gone")


def poll(tid: int) -> StopReport | None:
    """What a tracee has to report, if anything; it then stands (or is gone)."""
    try:
        reported, status = os.waitpid(tid, os.WNOHANG | _WALL)
    except ChildProcessError:
        return StopReport("gone")
    return _report(tid, status) if reported else None


def _report(tid: int, status: int) -> StopReport:
    """What the status of a wait tells."""
    if status == _STOPPED_BY_INTERRUPT:  # what is met in a pause
        return _INTERRUPTED
    if not os.WIFSTOPPED(status):
        return StopReport("gone", os.WTERMSIG(status), os.WEXITSTATUS(status))
    number, event = os.WSTOPSIG(status), status >> 16
    if event == _EVENT_STOP:
        return StopReport("group_stop" if number in _STOP_SIGNALS else "interrupted", number)
    if event in _EVENTS:
        return StopReport(_EVENTS[event])
    if number == _STOPPED_AT_CALL:
        return StopReport("call")
    return _signal_report(tid, number)


def _signal_report(tid: int, number: int) -> StopReport:
    if number != signal.SIGTRAP:
        return StopReport("signal", number)
    try:
        kind = _OUR_TRAPS.get(signal_code(tid))
    except GoneError:  # killed meanwhile; its end is reported next
        return StopReport("signal", number)
    return StopReport("signal", number) if kind is None else StopReport(kind)


def signal_code(tid: int) -> int:
    """Why a tracee that stands at a signal gets it: ``si_code`` of sigaction(2)."""
    return int.from_bytes(_siginfo(tid)[8:12], "little", signed=True)


def sent_by_another(tid: int, number: int | None = None) -> bool:
    """Whether another process has sent the signal at which a tracee of one thread stands.

    Nobody has sent one whose ``si_code`` is above 0 (SI_USER); of the others ``si_pid`` says who. The
    tracee's own ``number`` may be another one in its pid namespace.
    """
    sender = int.from_bytes(_siginfo(tid)[16:20], "little")
    return signal_code(tid) <= 0 and sender != (tid if number is None else number)


def signal_sender(tid: int) -> int | None:
    """The process that has sent the signal at which a tracee stands; None if the kernel has.

    By the number that it has in the tracee's pid namespace: 0 if it is outside.
    """
    return int.from_bytes(_siginfo(tid)[16:20], "little") if signal_code(tid) in _SENT else None


def _siginfo(tid: int) -> bytes:
    siginfo = ctypes.create_string_buffer(_SIGINFO_SIZE)
    _call(_GETSIGINFO, tid, data=ctypes.addressof(siginfo))
    return siginfo.raw
