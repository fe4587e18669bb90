"""A copy of a process that does not cooperate, made where one of its threads begins a call of a function.

The thread is led through a few instructions that fork it, wait for the end of the copy, give it back all
registers, and lead it back. They need nothing more of us: if the injector is killed, the copy dies, and the
thread comes through and buries it. The copy is a child of the process, which hears nothing of it, for its
end raises no signal. Sources: clone(2), wait4(2), System V ABI 3.2.2 (no red zone where a call begins).
"""

from __future__ import annotations

import os
import signal
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from injector.attach.untrapped_tracees import UntrappedTracees
from injector.block_profile.injected_call import CopyError, injected_call
from injector.faults.stopped_thread import TargetError
from injector.isa.x86_64_registers import X8664Registers
from injector.tracing import ptrace
from injector.tracing.elf import segment_end
from injector.tracing.perf_events import Breakpoint
from injector.tracing.process import AddressError, Process, ProcessIdentity, VanishedError
from injector.tracing.ptrace import NT_PRSTATUS, GoneError, StopReport
from injector.tracing.tracee import Tracee
from injector.tracing.waiting import wait_until

LIMIT_S = 10.0
"""Wall time for the few instructions, and the fork of a large process."""

_CLONE, _WAIT4, _EXIT_GROUP, _MPROTECT = 56, 61, 231, 10  # numbers of system calls on x86-64
_CLONE_FILES = 0x400
"""One table of descriptors for both: what the process closes meanwhile is closed, though the copy lives."""
_WALL = 0x40000000
_PROT_READ = 1
_SET_SIZE = 512
_WORD = struct.Struct("<Q")
_BELOW = 128
_KEPT = ("r9", "r8", "r10", "rdx", "rsi", "rdi", "r11", "rcx")
_ARGUMENTS = ("rdi", "rsi", "rdx", "r10", "r8", "r9")
_RESERVED_FLAG = 2


def _move(opcode: int, value: int) -> bytes:
    return bytes([opcode]) + struct.pack("<I", value)


_BACK = bytes.fromhex("4159 4158 415a 5a 5e 5f 415b 59 9d 58") + b"\xc2" + struct.pack("<H", _BELOW)
"""pop of each of ``_KEPT``, popfq, pop rax, ret 128."""
_AGAIN = _move(0xB8, _WAIT4) + bytes.fromhex("0f05 83f8fc")  # mov eax,61; syscall; cmp eax,-EINTR
_BURY = b"\x89\xc7" + _move(0xBA, _WALL) + _AGAIN + b"\x74" + bytes([256 - len(_AGAIN) - 2])
"""mov edi,eax; mov edx,__WALL; wait4, again as long as a signal ends it."""
_EXIT = _move(0xB8, _EXIT_GROUP) + b"\x0f\x05"  # mov eax,231; syscall
_FORK = (
    bytes.fromhex("0f05 85c0 74") + bytes([2 + len(_BURY + _BACK), 0x78, len(_BURY)]) + _BURY + _BACK + _EXIT
)
"""syscall; test eax,eax; jz to the end of a copy; js back, if there is none; else wait for its end first."""


@contextmanager
def copy_at_entry(
    tracees: UntrappedTracees, thread: Tracee, process: Process
) -> Iterator[tuple[Tracee, Process]]:
    """A copy of a process whose thread stands where a call begins; it stands there, too, and dies with us.

    What it shares with other processes, it may not write. It is killed in the end.

    :raises CopyError: if there is none.
    :raises GoneError: if the thread is killed.
    """
    own = ptrace.read_registers(thread.tid, NT_PRSTATUS, _SET_SIZE)
    place, true = _place(process, thread.tid)
    detour = _Detour(tracees, thread)
    try:
        process.write_memory(place, _FORK)
        if process.read_memory(place, len(_FORK)) != _FORK:
            raise CopyError(f"process {process.pid} was not copied: its code cannot be written")
        with Breakpoint(thread, detour.entry, 1, tracees.notice):
            detour.begin(process, place)
            try:
                copy = Tracee(detour.copy, detour.copy, StopReport("interrupted"))
                with _standing(copy, own, place, true) as copied:
                    yield copy, copied
            finally:
                _end(detour.copy)
                detour.end()
    except AddressError as error:
        raise CopyError(f"process {process.pid} was not copied: {error}") from error
    finally:
        if detour.is_back:  # else it needs them still, and nobody what was there
            with suppress(AddressError):
                process.write_memory(place, true)


@contextmanager
def _standing(copy: Tracee, own: bytearray, place: int, true: bytes) -> Iterator[Process]:
    """The copy, standing where its original does, with what it must not change protected."""
    if ptrace.await_report(copy.tid).kind == "gone":
        raise CopyError("the copy was killed")
    try:
        ptrace.die_with_us(copy.tid)
        ptrace.write_registers(copy.tid, NT_PRSTATUS, own)
        with Process(ProcessIdentity.of(copy.pid)) as process:
            process.write_memory(place, true)
            for shared in process.maps().shared():
                if "w" in shared.permissions:
                    size = shared.end - shared.start
                    if injected_call(copy.tid, process, _MPROTECT, shared.start, size, _PROT_READ):
                        raise CopyError("memory that it shares with others could not be protected")
            yield process
    except (AddressError, VanishedError, ptrace.GoneError) as error:
        raise CopyError(f"the copy was killed: {error}") from error


def _end(copy: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(copy, signal.SIGKILL)
    with suppress(ChildProcessError):
        while ptrace.await_report(copy).kind != "gone":
            pass


class _Detour:
    """The way of a thread through the few instructions: it is back when its copy has ended."""

    def __init__(self, tracees: UntrappedTracees, thread: Tracee) -> None:
        self._tracees, self._thread = tracees, thread
        self.entry = X8664Registers(thread.tid).program_counter
        self.copy = 0
        self.is_back = True

    def begin(self, process: Process, place: int) -> None:
        """Have the thread fork a copy; it waits for the end of that, its registers on the stack.

        :raises CopyError: if there is none.
        """
        registers = X8664Registers(self._thread.tid)
        kept = [registers.get(name) for name in _KEPT]
        kept += [registers.get("rflags") | _RESERVED_FLAG, registers.get("rax"), self.entry]
        frame = registers.stack_pointer - _BELOW - _WORD.size * len(kept)
        process.write_memory(frame, b"".join(map(_WORD.pack, kept)))
        arguments = dict.fromkeys(_ARGUMENTS, 0) | {"rdi": _CLONE_FILES}  # exit signal 0: it raises none
        for name, value in {"rip": place, "rsp": frame, "rax": _CLONE, **arguments}.items():
            registers.put(name, value)
        registers.commit()
        self._thread.report, self.is_back = None, False
        ptrace.resume(self._thread.tid)
        self._run(lambda: self.copy > 0 or self.is_back)
        if not self.copy:
            raise CopyError(f"process {process.pid} was not copied: the kernel gives it no memory or process")
        self._thread.report = StopReport("step")  # it waits; what it reports can wait, too

    def end(self) -> None:
        """Have the thread stand where it stood; its copy has ended."""
        self._thread.report = None
        self._run(lambda: self.is_back)

    def _run(self, is_there: Callable[[], bool]) -> None:
        def look() -> Literal[True] | None:
            self._take_news()
            return is_there() or None

        if wait_until(look, LIMIT_S) is None:
            message = f"thread {self._thread.tid} did not come back within {LIMIT_S:g} s"
            raise TargetError(message)

    def _take_news(self) -> None:
        thread = self._thread
        report = self._tracees.news_of(thread)
        if report is None:
            return
        if report.kind == "gone":
            message = f"thread {thread.tid} was killed"
            raise GoneError(message)
        if report.kind == "new_thread":
            self.copy = ptrace.started(thread.tid)
            self._tracees.threads.pop(self.copy, None)
        self.is_back = report.kind == "timer" and ptrace.program_counter(thread.tid) == self.entry
        if not self.is_back:
            thread.report = None
            ptrace.resume(thread.tid)  # its signals are owed until it is where it was


def _place(process: Process, tid: int) -> tuple[int, bytes]:
    """Where the few instructions may lie, and what is there: behind a file's segment, at a page's end."""
    try:
        status = Path(f"/proc/{process.pid}/task/{tid}/status").read_text()
    except OSError as error:
        raise CopyError(f"process {process.pid} ends") from error
    if "shstk" in status.partition("x86_Thread_features:")[2].partition("\n")[0]:
        raise CopyError("the processor guards the program's return addresses (shadow stack)")
    if status.partition("Seccomp:")[2].split(maxsplit=1)[0] != "0":
        raise CopyError("the program's calls of the kernel are filtered (seccomp)")
    for piece in process.maps().code():
        if piece.permissions == "r-xp" and piece.path:
            place = piece.end - len(_FORK)
            if segment_end(process.pid, piece) <= place:
                return place, process.read_memory(place, len(_FORK))
    raise CopyError("no file of the program has room behind its code")
