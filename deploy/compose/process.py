"""One start of a process under its reaper: what the reaper reports."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from deploy.compose.stack_file import ProcessSpec
from deploy.compose.system.process_tree import MARK, NAMESPACE, descendants
from deploy.compose.system.reaper import CHANNEL
from services.system.process_stat import ProcessStat

_DATAGRAM_BYTES = 1 << 16
# Isolated: the process's environment, which is the reaper's as well, cannot change how the reaper runs.
_REAPER = ("-I", "-m", "deploy.compose.system.reaper")


def environment(spec: ProcessSpec, folder: Path, namespace: str) -> dict[str, str]:
    """The environment of a process of the stack in ``folder``: ours, its stack, and what it declares.

    The folder of our own interpreter comes first in PATH, so that ``zenfi`` and ``python`` are ours.
    """
    own = str(Path(sys.executable).parent)
    path = os.environ.get("PATH", os.defpath)
    return {
        **os.environ,
        "PATH": f"{own}{os.pathsep}{path}",
        **spec.environment,
        MARK: str(folder),
        NAMESPACE: namespace,
    }


class SupervisedProcess:
    """A reaper with its process. ``output`` is where all that they write can be read.

    ``pid`` is the process's, 0 until it runs; ``status`` stays None until its whole family is gone.
    ``over_limit`` says, once it was killed for that, which limit it was over.
    """

    def __init__(self, number: int, spec: ProcessSpec, environment: Mapping[str, str]) -> None:
        self.number = number
        self._since_s = time.monotonic()
        self.spec = spec
        self.pid = 0
        self.error = ""
        self.over_limit = ""
        self.status: int | None = None
        self.killed = 0
        self.refused = 0
        self.channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel.setblocking(False)
        self.output, written = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        os.set_blocking(written, True)
        try:
            self.reaper = os.posix_spawn(
                sys.executable,
                [sys.executable, *_REAPER, spec.folder, str(spec.limits.open_files or 0), *spec.command],
                environment,
                file_actions=[
                    (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
                    (os.POSIX_SPAWN_DUP2, written, 1),
                    (os.POSIX_SPAWN_DUP2, written, 2),
                    (os.POSIX_SPAWN_DUP2, theirs.fileno(), CHANNEL),
                ],
                setsid=True,
            )
        except BaseException:
            self.close()
            raise
        finally:
            os.close(written)
            theirs.close()

    @property
    def age_s(self) -> float:
        """The time since the process was started, in seconds."""
        return time.monotonic() - self._since_s

    def send(self, number: int) -> None:
        """Send a signal to the process through its reaper; one that is gone needs none."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.channel.send(str(number).encode())

    def kill(self) -> None:
        """Kill the process and all its descendants."""
        self.send(signal.SIGKILL)

    def hear(self) -> bool:
        """Take in one report of the reaper; False once it sends no more.

        :raises BlockingIOError: if there is none now.
        """
        try:
            data = self.channel.recv(_DATAGRAM_BYTES)
        except ConnectionResetError:
            return False
        if not data:
            return False
        report = json.loads(data)
        self.pid = report.get("pid", self.pid)
        self.error = report.get("error", self.error)
        if "status" in report:
            self.status, self.killed, self.refused = (report[n] for n in ("status", "killed", "refused"))
        return True

    def family(self) -> dict[int, ProcessStat]:
        """The process and its descendants, by pid."""
        return descendants(self.reaper)

    def close(self) -> None:
        """Close the descriptors; a reaper that still runs then ends its family and itself."""
        self.channel.close()
        os.close(self.output)
