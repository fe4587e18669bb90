"""Calls of the kernel that a standing tracee is made to do; it gets its registers back. x86-64 only."""

from __future__ import annotations

import struct

from injector.isa.x86_64_registers import entering, outside_of_calls
from injector.tracing import ptrace
from injector.tracing.process import Process
from injector.tracing.ptrace import NT_PRSTATUS

_SYSTEM_CALL = b"\x0f\x05"
_SET_SIZE, _RAX_AT = 512, 80
_RESULT = struct.Struct("<q")
_CLONE, _WAIT4 = 56, 61  # numbers of system calls on x86-64
_ANY_CHILD, _WALL = 2**64 - 1, 0x40000000


class CopyError(Exception):
    """A process could not be copied: one line."""


def injected_call(tid: int, process: Process, number: int, *arguments: int) -> int:
    """Have a thread make a call of the kernel; what that returned."""
    own = outside_of_calls(ptrace.read_registers(tid, NT_PRSTATUS, _SET_SIZE))
    here = ptrace.program_counter(tid)
    with process.changed_code(here, _SYSTEM_CALL, process.read_memory(here, len(_SYSTEM_CALL))):
        ptrace.write_registers(tid, NT_PRSTATUS, entering(own, here, number, *arguments))
        ptrace.step(tid)
        ptrace.await_report(tid)
        (result,) = _RESULT.unpack_from(ptrace.read_registers(tid, NT_PRSTATUS, _SET_SIZE), _RAX_AT)
        ptrace.write_registers(tid, NT_PRSTATUS, own)
    return int(result)


def injected_fork(tid: int, process: Process) -> int:
    """A copy of a process of one thread, traced; both stand where it stands. It is a child of the process.

    The process hears nothing of its end, and is to bury it (:func:`bury_child`).

    :raises CopyError: if there is none.
    """
    own = outside_of_calls(ptrace.read_registers(tid, NT_PRSTATUS, _SET_SIZE))
    here = ptrace.program_counter(tid)
    true = process.read_memory(here, len(_SYSTEM_CALL))
    with process.changed_code(here, _SYSTEM_CALL, true):
        ptrace.write_registers(tid, NT_PRSTATUS, entering(own, here, _CLONE, 0, 0, 0, 0, 0))
        ptrace.step(tid)
        report = ptrace.await_report(tid)
        if report.kind != "new_thread":  # so it is called if its end raises no SIGCHLD
            ptrace.write_registers(tid, NT_PRSTATUS, own)
            message = f"process {tid} was not copied but reported {report.kind}"
            raise CopyError(message)
        copy = ptrace.started(tid)
        ptrace.step(tid)
        ptrace.await_report(tid)
        ptrace.await_report(copy)
        for one in (tid, copy):
            ptrace.write_registers(one, NT_PRSTATUS, own)
    return copy


def restore_copy(process: Process, tid: int, of: Process) -> None:
    """Put back the code in a copy that was changed in the process for the fork."""
    here = ptrace.program_counter(tid)
    process.write_memory(here, of.read_memory(here, len(_SYSTEM_CALL)))


def bury_child(tid: int, process: Process) -> None:
    """Have a process wait for a child of its that has ended."""
    injected_call(tid, process, _WAIT4, _ANY_CHILD, 0, _WALL, 0)
