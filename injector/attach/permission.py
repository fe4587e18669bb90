"""Checks whether a process that was named by its pid can be injected into, before it is touched."""

from __future__ import annotations

import os
from pathlib import Path
from pwd import getpwuid

from injector.tracing.process import (
    ChangedError,
    IdentityError,
    Process,
    ProcessIdentity,
    VanishedError,
    has_ended,
    threads,
    tracer_of,
)
from services.system.process_stat import is_stopped, process_stat

_YAMA = Path("/proc/sys/kernel/yama/ptrace_scope")
_PF_KTHREAD = 0x00200000
_ELF_CLASS_AT, _ELF_64 = 4, 2


class AttachRefusedError(Exception):
    """The process cannot be injected into: one line that says why and what to do."""


def admit(pid: int, kind: type[Process] = Process) -> Process:
    """Get hold of a process that was named explicitly. It has not been touched.

    :raises AttachRefusedError: if it cannot be injected into.
    """
    try:
        _admissible(pid)
        process = kind(ProcessIdentity.of(pid))
    except (VanishedError, FileNotFoundError, ProcessLookupError) as error:  # also if it ends meanwhile
        raise AttachRefusedError(f"there is no process {pid}") from error
    except ChangedError as error:
        raise AttachRefusedError(changed(pid)) from error
    except (IdentityError, PermissionError) as error:
        raise AttachRefusedError(not_permitted(pid)) from error
    try:
        _is_64_bit(pid)
    except BaseException:
        process.close()
        raise
    return process


def _admissible(pid: int) -> None:
    _exists(pid)
    if pid == os.getpid():
        raise AttachRefusedError(f"process {pid} is this injector itself")
    stat = process_stat(pid)
    if stat.flags & _PF_KTHREAD:
        raise AttachRefusedError(
            f"process {pid} ({name_of(pid)}) is a thread of the kernel: it runs no user code"
        )
    if stat.state in "ZX":
        raise AttachRefusedError(f"process {pid} ({name_of(pid)}) has ended: it is a zombie")
    tracer = tracer_of(pid)
    if tracer:
        message = f"process {pid} is traced by process {tracer} ({name_of(tracer)}): end that first"
        raise AttachRefusedError(message)


def _exists(pid: int) -> None:
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError as error:
        raise AttachRefusedError(f"there is no process {pid}") from error
    leader = int(status.partition("Tgid:")[2].split(maxsplit=1)[0])
    if leader != pid:
        raise AttachRefusedError(f"{pid} is a thread of process {leader}: give --pid {leader} --thread {pid}")


def _is_64_bit(pid: int) -> None:
    try:
        with Path(f"/proc/{pid}/exe").open("rb") as file:
            head = file.read(_ELF_CLASS_AT + 1)
    except PermissionError as error:
        raise AttachRefusedError(not_permitted(pid)) from error
    except OSError as error:
        raise AttachRefusedError(f"there is no process {pid}") from error
    if head[:4] != b"\x7fELF" or head[_ELF_CLASS_AT] != _ELF_64:
        raise AttachRefusedError(
            f"process {pid} ({name_of(pid)}) is 32-bit: only 64-bit processes can be injected into"
        )


def check_runs(pid: int, what: str) -> None:
    """Refuse a process that somebody has stopped where ``what`` is asked of it.

    :raises AttachRefusedError: saying what to do.
    """
    if is_stopped(pid):
        message = f"process {pid} ({name_of(pid)}) is stopped, and {what} needs one that runs"
        raise AttachRefusedError(
            f"{message}: kill -CONT {pid}, or leave that out to strike it where it stands"
        )


def changed(pid: int) -> str:
    """What to say of a process that became another one while it was looked at: one line."""
    return f"process {pid} ({name_of(pid)}) has become another program or user meanwhile: try again"


def not_permitted(pid: int) -> str:
    """Why the kernel may have forbidden it, and what to do: one line."""
    try:
        owner = _owner(pid)
    except OSError:
        return f"there is no process {pid}"
    head = f"not permitted to trace process {pid} ({name_of(pid)})"
    if os.geteuid() not in (0, owner):
        return f"{head}: it belongs to user {_user(owner)}: run zenfi as that user, or as root"
    try:
        scope = int(_YAMA.read_text())
    except OSError:
        scope = 0
    if scope and os.geteuid():
        how = "sysctl kernel.yama.ptrace_scope=0, or run zenfi as root"
        how = how if scope < 3 else "only a reboot lifts that"
        return f"{head}: Yama's ptrace_scope is {scope}: {how}"
    return (
        f"{head}: it has privileges of its own, or a container forbids it: run zenfi as root, and the "
        "container with --cap-add SYS_PTRACE --cap-add PERFMON and a seccomp profile that allows ptrace"
    )


def _owner(pid: int) -> int:
    return os.stat(f"/proc/{pid}").st_uid  # noqa: PTH116


def _user(uid: int) -> str:
    try:
        return getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def name_of(tid: int) -> str:
    """What a process or thread calls itself; empty if it is gone."""
    try:
        return Path(f"/proc/{tid}/comm").read_text().strip()
    except OSError:
        return ""


def check_thread(pid: int, tid: int) -> None:
    """Refuse a thread that is not the process's.

    :raises AttachRefusedError: naming those that are.
    """
    own = threads(pid)
    if tid not in own or has_ended(tid):
        several = ", ".join(f"{one} ({name_of(one)})" for one in own[:20])
        raise AttachRefusedError(f"process {pid} has no thread {tid}; its threads: {several}")
