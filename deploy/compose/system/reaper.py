"""The reaper: the parent of one process of a stack, which kills all that the process leaves behind.

It is a subreaper, so whatever its process forks stays its descendant, also what daemonises itself.
When the process has ended, or the supervisor is gone (its end of the socket closes, whatever it died
of), the reaper kills the rest, then ends. If the reaper itself is killed, its process dies with it and
the rest falls to the supervisor, a subreaper as well.

It talks over a socket of datagrams: signals to be sent in (a decimal number), reports out (``{"pid": ...}``
or ``{"error": ...}``; then ``{"status": ..., "killed": ..., "refused": ...}``). It keeps to the standard
library, so it starts in some 20 ms.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import resource
import select
import signal
import socket
import sys
from pathlib import Path

from deploy.compose.system.process_tree import become_subreaper, end_family, reaped
from services.system.lifeline import die_with_parent

CHANNEL = 3
"""The descriptor of the socket."""

_DATAGRAM_BYTES = 4096
_EXIT_EXEC = 127


def main() -> None:
    """Entry point: arguments are the working folder, the limit of open files (0: none) and the command."""
    folder, open_files, *command = sys.argv[1:]
    channel = socket.socket(fileno=CHANNEL)
    channel.set_inheritable(False)
    Path("/proc/self/comm").write_text("zenfi-reaper")
    become_subreaper()
    # The supervisor alone orders a reaper about.
    for one in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(one, signal.SIG_IGN)
    woken, waker = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
    signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    try:
        child = _start(folder, int(open_files), command)
    except OSError as error:
        end_family()
        _report(channel, {"error": f"{error.filename}: {os.strerror(error.errno or errno.EIO)}"})
        return
    _report(channel, {"pid": child})
    status = _keep(channel, woken, child)
    killed, refused = end_family()
    _report(channel, {"status": status, "killed": killed, "refused": refused})


def _report(channel: socket.socket, report: dict[str, object]) -> None:
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the supervisor is gone: nobody asks
        channel.send(json.dumps(report).encode())


def _start(folder: str, open_files: int, command: list[str]) -> int:
    """Fork and execute the process; return its pid.

    :raises OSError: naming the folder or program that cannot be used.
    """
    reading, writing = os.pipe2(os.O_CLOEXEC)
    reaper = os.getpid()
    child = os.fork()
    if child == 0:
        try:
            die_with_parent(reaper)
            os.setsid()
            signal.set_wakeup_fd(-1)
            # Python ignores SIGPIPE and SIGXFSZ; what is ignored stays so across exec.
            for one in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
                with contextlib.suppress(OSError):
                    signal.signal(one, signal.SIG_DFL)
            wrong = "open_files"
            if open_files:
                resource.setrlimit(resource.RLIMIT_NOFILE, (open_files, open_files))
            wrong = folder
            os.chdir(folder)
            wrong = command[0]
            os.execvp(command[0], command)  # noqa: S606 - no shell is what we want
        except OSError as error:
            os.write(writing, json.dumps([error.errno, wrong]).encode())
        finally:
            os._exit(_EXIT_EXEC)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        wrong_with = pipe.read()
    if wrong_with:
        number, name = json.loads(wrong_with)
        raise OSError(number or errno.EIO, "not started", name)
    return child


def _keep(channel: socket.socket, woken: int, child: int) -> int:
    """Wait for the process's end and reap all orphans meanwhile; return the process's status."""
    poll = select.poll()
    poll.register(channel, select.POLLIN)
    poll.register(woken, select.POLLIN)
    while True:
        for descriptor, _ in poll.poll():
            if descriptor == channel.fileno():
                _obey(channel, child)
            else:
                os.read(woken, _DATAGRAM_BYTES)
        for pid, status in reaped():
            if pid == child:
                return status


def _obey(channel: socket.socket, child: int) -> None:
    try:
        order = channel.recv(_DATAGRAM_BYTES)
    except ConnectionResetError:
        order = b""
    if not order:  # the supervisor is gone
        end_family()
        sys.exit(1)
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, int(order))


if __name__ == "__main__":
    main()
