"""A copy of a process that does not cooperate, made where one of its threads begins a call of a function.

The thread is led through a few instructions that fork it, give it back all registers, and lead it back. They
need nothing more of us: if the injector is killed, the thread comes through all the same, and the copy ends.
The copy is a child of the process, which hears nothing of it; in the end the process is led through the same
instructions to bury it. Sources: clone(2), wait4(2), System V ABI 3.2.2 (no red zone where a call begins).
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
from services.system.process_stat import own_number

LIMIT_S = 10.0
"""Wall time for the few instructions, and the fork of a large process."""

_CLONE, _WAIT4, _EXIT_GROUP, _MPROTECT = 56, 61, 231, 10  # numbers of system calls on x86-64
_WALL = 0x40000000
_AT_ENTRY = 9
_PROT_READ = 1
_SET_SIZE = 512
_PAIR, _WORD = struct.Struct("<QQ"), struct.Struct("<Q")
_BELOW = 128
_KEPT = ("r9", "r8", "r10", "rdx", "rsi", "rdi", "r11", "rcx")
_ARGUMENTS = ("rdi", "rsi", "rdx", "r10", "r8", "r9")
_RESERVED_FLAG = 2

_BACK = bytes.fromhex("4159 4158 415a 5a 5e 5f 415b 59 9d 58") + b"\xc2" + struct.pack("<H", _BELOW)
"""pop of each of ``_KEPT``, popfq, pop rax, ret 128."""
_EXIT = b"\xb8" + struct.pack("<I", _EXIT_GROUP) + b"\x0f\x05"  # mov eax,231; syscall
_CALL = b"\x0f\x05\x85\xc0\x74" + bytes([len(_BACK)]) + _BACK + _EXIT
"""syscall; test eax,eax; jz to the end of a copy; back to where the thread was."""


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
    place, true = _place(process)
    try:
        made = _call(tracees, thread, process, place, true, _CLONE, 0, 0, 0, 0, 0)
    except AddressError as error:
        raise CopyError(f"process {process.pid} was not copied: {error}") from error
    if not made:
        raise CopyError(f"process {process.pid} was not copied: the kernel gives it no memory or process")
    copy = Tracee(made, made, StopReport("interrupted"))
    number = 0
    try:
        with suppress(OSError, VanishedError):
            number = own_number(made)
        with _standing(copy, own, place, true) as copied:
            yield copy, copied
    finally:
        _end(copy)
        _call(tracees, thread, process, place, true, _WAIT4, number or made, 0, _WALL, 0)


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
                    injected_call(copy.tid, process, _MPROTECT, shared.start, size, _PROT_READ)
            yield process
    except (AddressError, VanishedError, ptrace.GoneError) as error:
        raise CopyError(f"the copy was killed: {error}") from error


def _end(copy: Tracee) -> None:
    with suppress(ProcessLookupError):
        os.kill(copy.pid, signal.SIGKILL)
    with suppress(ChildProcessError):
        while ptrace.await_report(copy.tid).kind != "gone":
            pass


def _call(
    tracees: UntrappedTracees,
    thread: Tracee,
    process: Process,
    place: int,
    true: bytes,
    number: int,
    *arguments: int,
) -> int:
    """Have the thread make a call of the kernel and stand where it stood; what that has started, if any."""
    registers = X8664Registers(thread.tid)
    entry, stack = registers.program_counter, registers.stack_pointer
    kept = [registers.get(name) for name in _KEPT]
    kept += [registers.get("rflags") | _RESERVED_FLAG, registers.get("rax"), entry]
    frame = stack - _BELOW - _WORD.size * len(kept)
    process.write_memory(frame, b"".join(map(_WORD.pack, kept)))
    with (
        process.changed_code(place, _CALL, true),
        Breakpoint(thread, entry, 1, tracees.notice),
    ):
        changed = {
            "rip": place,
            "rsp": frame,
            "rax": number,
            **dict(zip(_ARGUMENTS, arguments, strict=False)),
        }
        for name, value in changed.items():
            registers.put(name, value)
        registers.commit()
        return tracees.run_to(thread, entry, LIMIT_S)


def _place(process: Process) -> tuple[int, bytes]:
    """Where the few instructions may lie, and what is there: at the program's first instruction.

    That is executed once, when the program begins.
    """
    status = Path(f"/proc/{process.pid}/status").read_text()
    if "shstk" in status.partition("x86_Thread_features:")[2].partition("\n")[0]:
        raise CopyError("the processor guards the program's return addresses (shadow stack)")
    pairs = dict(_PAIR.iter_unpack(Path(f"/proc/{process.pid}/auxv").read_bytes()))
    place = pairs.get(_AT_ENTRY, 0)
    mapping = process.maps().at(place)
    if mapping is None or mapping.permissions != "r-xp" or mapping.end - place < len(_CALL):
        raise CopyError(f"the code at the program's beginning ({place:#x}) is not as usual")
    return place, process.read_memory(place, len(_CALL))
