"""Process that launches programs: in a pid namespace of its own, stopped until the injector traces it.

It reads orders from standard input and writes answers to standard output, in lines of JSON; after the answer
with the program's pid it waits for one more byte before the program begins. A program finds the same memory
in each run: address randomisation is off, its stack and pid are the same, and it has no signals blocked. All
of its threads have the processor that is named to us, whatever they ask for. Where we may, we have all files
read-only to it but those in the folder that is named to us: a fault could have it remove them.

Of Python and ours it has no more than it needs, so that forking takes half a millisecond.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import resource
import signal
import struct
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from injector.reproducible import pid_namespace
from injector.reproducible.read_only_files import make_all_read_only
from services.system.libc import checked, libc, turn_address_randomisation_off
from services.system.lifeline import die_with_parent
from services.system.process_stat import listed_pid

STACK_BYTES = 8 << 20
"""Soft limit of the stack, by which the kernel places what is mapped."""

_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _PR_SET_CHILD_SUBREAPER, _FILTER = 38, 22, 36, 2
_X86_64, _GETRANDOM, _SETAFFINITY = 0xC000003E, 318, 203
_TRACE, _ALLOW, _RETURN_0 = 0x7FF00000, 0x7FFF0000, 0x00050000  # what a filter answers
_LOAD, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x15, 0x06
_NUMBER_AT, _ARCHITECTURE_AT = 0, 4  # in struct seccomp_data
_INSTRUCTION = struct.Struct("=HBBI")


def main() -> None:
    """Launch a program for each order until there are no more."""
    die_with_parent()
    turn_address_randomisation_off()
    _set_limit(resource.RLIMIT_STACK, STACK_BYTES)
    _set_limit(resource.RLIMIT_CORE, 0)
    _have_default_signals()
    own_pids = pid_namespace.begin() != pid_namespace.NOWHERE and _next_pid_is_2()
    libc.prctl(_PR_SET_CHILD_SUBREAPER, 1)
    protected = make_all_read_only([sys.argv[2]])
    os.sched_setaffinity(0, {int(sys.argv[1])})
    _filter_calls()
    gc.freeze()
    orders = sys.stdin.buffer
    while line := orders.readline():
        _launch(json.loads(line), own_pids=own_pids, protected=protected)
    os._exit(os.EX_OK)


def _next_pid_is_2() -> bool:
    """Have the next process here get pid 2, those after it the numbers that follow; whether that is allowed.

    By CAP_SYS_ADMIN in the namespace (pid_namespaces(7)), which whoever made it has.
    """
    try:
        Path("/proc/sys/kernel/ns_last_pid").write_text("1")
    except OSError:
        return False
    return os.getpid() == 1


def _set_limit(which: int, wanted: int) -> None:
    _, most = resource.getrlimit(which)
    resource.setrlimit(which, (wanted if most == resource.RLIM_INFINITY else min(wanted, most), most))


def _launch(order: dict[str, Any], *, own_pids: bool, protected: bool) -> None:
    """Fork the program, tell of it and of its end; all that it has started has ended then."""
    if own_pids:
        _next_pid_is_2()
    reads, writes = os.pipe()
    failed, failure = os.pipe()
    pid = os.fork()
    if not pid:
        die_with_parent()
        os.close(writes)
        _become(order, reads, failure)
    os.close(failure)
    os.close(reads)
    _tell({"pid": listed_pid(pid), "own_pids": own_pids, "protected": protected})
    os.read(sys.stdin.fileno(), 1)
    os.write(writes, b"x")
    os.close(writes)
    problem = os.read(failed, 256).decode()
    os.close(failed)
    _, status, usage = os.wait4(pid, 0)
    if own_pids:
        with suppress(ProcessLookupError):
            os.kill(-1, signal.SIGKILL)  # all in the namespace but us
    cpu_s = usage.ru_utime + usage.ru_stime
    _tell({"status": os.waitstatus_to_exitcode(status), "cpu_s": cpu_s, "problem": problem})
    with suppress(ChildProcessError):  # where we have no namespace, the tracer kills them
        while True:
            os.waitpid(-1, 0)


def _tell(answer: dict[str, Any]) -> None:
    try:
        os.write(sys.stdout.fileno(), json.dumps(answer).encode() + b"\n")
    except BrokenPipeError:  # whoever ordered has closed, and wants no run any more
        os._exit(os.EX_OK)


def _become(order: dict[str, Any], go: int, failure: int) -> NoReturn:
    """Execute the program once a byte has come; what is in its way is written to ``failure``."""
    try:
        os.setsid()
        os.chdir(order["folder"])
        _set_limit(resource.RLIMIT_FSIZE, order["largest_file"])
        if not os.read(go, 1):
            os._exit(126)
        for descriptor, (path, flags) in enumerate(order["streams"]):
            opened = os.open(path, flags, 0o600)
            os.dup2(opened, descriptor)
            os.close(opened)
        os.execve(order["executable"], order["arguments"], order["environment"])  # noqa: S606 - no shell
    except BaseException as error:  # noqa: BLE001 - this process has nobody else to tell
        os.write(failure, str(error).encode()[:256])
    os._exit(126)  # as a shell says that it could not execute it


def _have_default_signals() -> None:
    """Have no signals blocked, ignored or handled, as programs that are started from here find it, too."""
    for number in range(1, signal.NSIG):
        with suppress(OSError, ValueError):
            signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())


def _filter_calls() -> None:
    """Have who traces what we start told of each call of getrandom(2), and sched_setaffinity(2) do nothing.

    The rest runs at full speed. Threads on several processors would run in another order each time, and
    passes through the same instruction at once would be counted as one. Without a tracer getrandom fails;
    this process makes no such call.
    """
    program = b"".join(
        _INSTRUCTION.pack(*one)
        for one in (
            (_LOAD, 0, 0, _ARCHITECTURE_AT),
            (_JUMP_IF_EQUAL, 0, 5, _X86_64),
            (_LOAD, 0, 0, _NUMBER_AT),
            (_JUMP_IF_EQUAL, 0, 1, _GETRANDOM),
            (_RETURN, 0, 0, _TRACE),
            (_JUMP_IF_EQUAL, 0, 1, _SETAFFINITY),
            (_RETURN, 0, 0, _RETURN_0),
            (_RETURN, 0, 0, _ALLOW),
        )
    )
    content = ctypes.create_string_buffer(program, len(program))
    described = ctypes.create_string_buffer(
        struct.pack("=H6xQ", len(program) // _INSTRUCTION.size, ctypes.addressof(content))
    )
    checked(libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0))
    checked(libc.prctl(_PR_SET_SECCOMP, _FILTER, described, 0, 0))


if __name__ == "__main__":
    main()
