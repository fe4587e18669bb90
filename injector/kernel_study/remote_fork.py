"""Forking a process that stands, from outside: the copy stands where it stands, before the same instruction.

The tracee is made to enter ``clone`` and gets its registers back. Nothing of the fork is seen by the
program, and its interpreter does not tidy up after it: process and copy go on alike. Signals that are under
way to it, such as the mark at the end of its call, wait meanwhile; as with any fork, they are not the
copy's. x86-64 only.
"""

from __future__ import annotations

import ctypes
import os
import signal
from contextlib import suppress

from injector.isa.x86_64_registers import entering, entering_again
from injector.tracing import ptrace
from injector.tracing.ptrace import NT_PRSTATUS, GoneError, StopReport
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.system.c_library import CLONE
from services.system.libc import libc

_CLONE_PARENT = 0x8000
_SYSCALL = b"\x0f\x05"
_SET_SIZE = 512
_FUNCTION_SIZE = 64

# A step's trap must come through: blocked, the kernel would take away what the program does at one.
_HELD_BACK = ~(1 << signal.SIGTRAP - 1) & 0xFFFF_FFFF_FFFF_FFFF


class RemoteForkError(Exception):
    """A process could not be copied, and is gone or no longer what it was: one line."""


class RemoteForks:
    """Copies of processes that we trace, which are forks of ours (libc lies where ours does).

    ``tracees`` must follow forks. A copy is a child of our own, traced, and stands.
    """

    def __init__(self, tracees: TraceeGroup) -> None:
        self._tracees = tracees
        function = ctypes.cast(libc.syscall, ctypes.c_void_p).value or 0
        self._instruction = function + ctypes.string_at(function, _FUNCTION_SIZE).index(_SYSCALL)

    def copy(self, of: Tracee) -> Tracee:
        """A copy of the process whose only thread this is; both stand where it stands.

        :raises RemoteForkError: if the kernel makes none, or somebody else stops or kills it.
        """
        tid = of.tid
        try:
            made = self._clone(tid)
        except GoneError as error:
            message = f"process {tid} was not copied but killed"
            raise RemoteForkError(message) from error
        of.report = StopReport("step")
        self._tracees.threads[made] = Tracee(made, made, StopReport("interrupted"))
        return self._tracees.threads[made]

    def _clone(self, tid: int) -> int:
        blocked = ptrace.blocked_signals(tid)
        own = entering_again(ptrace.read_registers(tid, NT_PRSTATUS, _SET_SIZE))
        call = entering(own, self._instruction, CLONE, _CLONE_PARENT | signal.SIGCHLD, 0, 0, 0, 0)
        ptrace.write_registers(tid, NT_PRSTATUS, call)
        ptrace.block_signals(tid, _HELD_BACK)
        ptrace.resume(tid)
        report = ptrace.await_report(tid)
        if report.kind == "gone":
            del self._tracees.threads[tid]  # reaped: its number may be somebody else's by now
        if report.kind != "new_process":
            message = f"process {tid} was not copied but reported {report.kind} (signal {report.signal})"
            raise RemoteForkError(message)
        made = ptrace.started(tid)
        ptrace.step(tid)
        ptrace.await_report(tid)
        ptrace.await_report(made)
        for one in (tid, made):
            ptrace.write_registers(one, NT_PRSTATUS, own)
            ptrace.block_signals(one, blocked)
        return made

    def end(self, copy: Tracee) -> None:
        """Kill a copy and reap it; nothing happens if it has ended."""
        if self._tracees.threads.pop(copy.tid, None) is None:
            return
        with suppress(ProcessLookupError):
            os.kill(copy.pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            while ptrace.await_report(copy.tid).kind != "gone":
                pass
