"""A copy of a process that does not cooperate, made where one of its threads begins a call of a function.

The thread is led through a few instructions that fork the copy, wait for its end, give the thread back all
its registers and lead it back. They need nothing more of us: if the injector is killed at whatever moment, the
copy ends, the thread comes through all the same, and the process has no child left. It hears nothing of the
copy meanwhile: no signal tells of its end, and only who waits with ``__WALL`` could wait for it.

Sources: clone(2), wait4(2), vdso(7), System V ABI 3.2.2 (no red zone where a call begins).
"""

from __future__ import annotations

import os
import signal
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from injector.attach.untrapped_tracees import UntrappedTracees
from injector.block_profile.injected_call import CopyError, injected_call
from injector.isa.x86_64_registers import X8664Registers
from injector.tracing import ptrace
from injector.tracing.perf_events import Breakpoint
from injector.tracing.process import AddressError, Process, ProcessIdentity, VanishedError
from injector.tracing.ptrace import NT_PRSTATUS, StopReport
from injector.tracing.tracee import Tracee

LIMIT_S = 10.0
"""Wall time for the few instructions, and the fork of a large process."""

_CLONE, _WAIT4, _EXIT_GROUP, _MPROTECT = 56, 61, 231, 10  # numbers of system calls on x86-64
_WALL = 0x40000000
_EINTR = 4
_PROT_READ = 1
_SET_SIZE = 512
_WORD, _NUMBER = struct.Struct("<Q"), struct.Struct("<I")
_BELOW = 128
"""Bytes below the stack pointer that are left alone."""

_KEPT = ("r9", "r8", "r10", "rdx", "rsi", "rdi", "r11", "rcx")
_CLONE_ARGUMENTS = ("rdi", "rsi", "rdx", "r10", "r8", "r9")
_RESERVED_FLAG = 2
_NO_FILTER = "0"

_BACK = bytes.fromhex("4159 4158 415a 5a 5e 5f 415b 59 9d 58 c2") + struct.pack("<H", _BELOW)
"""pop of each of ``_KEPT``, popfq, pop rax, ret 128."""
_EXIT = b"\xb8" + _NUMBER.pack(_EXIT_GROUP) + b"\x0f\x05"
"""mov eax,231; syscall: how a copy ends by itself."""
_WAIT = b"".join(
    (
        bytes.fromhex("31f6 ba") + _NUMBER.pack(_WALL) + bytes.fromhex("4531d2"),  # no status, no usage
        b"\xb8" + _NUMBER.pack(_WAIT4) + b"\x0f\x05",
        bytes.fromhex("83f8") + (-_EINTR).to_bytes(1, signed=True),  # cmp eax,-4; then je to the beginning
    )
)
_WAIT += b"\x74" + (-len(_WAIT) - 2).to_bytes(1, signed=True)
_WAIT_FOR_CHILD = b"\x89\xc7" + _WAIT  # mov edi,eax
_CODE = b"".join(
    (
        b"\x0f\x05\x85\xc0",  # syscall (clone); test eax,eax
        b"\x78" + bytes([2 + len(_WAIT_FOR_CHILD)]),  # js: there is no copy
        b"\x74" + bytes([len(_WAIT_FOR_CHILD + _BACK)]),  # jz: this is the copy
        _WAIT_FOR_CHILD + _BACK + _EXIT,
    )
)
_ROOM = 128
_CODE += bytes(_ROOM - len(_CODE))


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
    registers = X8664Registers(thread.tid)
    entry = registers.program_counter
    try:
        place = _place(process, thread.tid)
        _prepare(process, registers, place)
    except AddressError as error:
        raise CopyError(f"its process was not copied: {error}") from error
    with Breakpoint(thread, entry, 1, tracees.notice):
        registers.commit()
        ptrace.resume(thread.tid)
        made = tracees.run_to(thread, entry, LIMIT_S)
        copy = Tracee(made, made, StopReport("interrupted"))
        try:
            if not made:
                raise CopyError("its process was not copied: the kernel gives it no memory or no process")
            thread.report = StopReport("interrupted")  # what it has to tell is heard when the copy is gone
            with _standing(copy, own) as copied:
                yield copy, copied
        finally:
            if made:
                _end(copy)
                tracees.run_to(thread, entry, LIMIT_S)
            with suppress(AddressError):  # not before the thread is back
                process.write_memory(place, bytes(_ROOM))


@contextmanager
def _standing(copy: Tracee, own: bytearray) -> Iterator[Process]:
    """The copy, standing where its original does, with what it must not change protected."""
    if ptrace.await_report(copy.tid).kind == "gone":
        raise CopyError("the copy of its process was killed")
    try:
        ptrace.die_with_us(copy.tid)
        ptrace.write_registers(copy.tid, NT_PRSTATUS, own)
        with suppress(OSError):  # if memory runs short, the copy is what the kernel takes
            Path(f"/proc/{copy.pid}/oom_score_adj").write_text("1000")
        with Process(ProcessIdentity.of(copy.pid)) as process:
            for shared in process.maps().shared():
                size = shared.end - shared.start
                if "w" in shared.permissions and injected_call(
                    copy.tid, process, _MPROTECT, shared.start, size, _PROT_READ
                ):
                    raise CopyError(f"the memory that it shares at {shared.start:#x} cannot be protected")
            yield process
    except (AddressError, VanishedError, ptrace.GoneError) as error:
        raise CopyError(f"the copy of its process was killed: {error}") from error


def _end(copy: Tracee) -> None:
    with suppress(ProcessLookupError):
        os.kill(copy.pid, signal.SIGKILL)
    with suppress(ChildProcessError):
        while ptrace.await_report(copy.tid).kind != "gone":
            pass


def _prepare(process: Process, registers: X8664Registers, place: int) -> None:
    """Lay down the instructions and what they give back, and registers that enter them."""
    kept = [registers.get(name) for name in _KEPT]
    kept += [registers.get("rflags") | _RESERVED_FLAG, registers.get("rax"), registers.program_counter]
    frame = registers.stack_pointer - _BELOW - _WORD.size * len(kept)
    process.write_memory(frame, b"".join(map(_WORD.pack, kept)))
    process.write_memory(place, _CODE)
    for name in _CLONE_ARGUMENTS:  # no flags: an end of which no signal tells
        registers.put(name, 0)
    for name, value in {"rip": place, "rsp": frame, "rax": _CLONE}.items():
        registers.put(name, value)


def _place(process: Process, tid: int) -> int:
    """Where the few instructions may lie: behind the code that the kernel maps, where nothing is.

    :raises CopyError: if they may not lie or run there.
    """
    status = Path(f"/proc/{tid}/status").read_text()
    if _field(status, "Seccomp") != _NO_FILTER:
        raise CopyError("a seccomp filter guards its thread, which may forbid a copy")
    if "shstk" in _field(status, "x86_Thread_features"):
        raise CopyError("the processor guards its return addresses (shadow stack)")
    for mapping in process.maps().code():
        place = mapping.end - _ROOM
        if mapping.name == "[vdso]" and process.read_memory(place, _ROOM) in (bytes(_ROOM), _CODE):
            return place
    raise CopyError("the kernel's code in it (vdso) has no room for a few instructions")


def _field(status: str, name: str) -> str:
    return status.partition(f"{name}:")[2].partition("\n")[0].strip()
