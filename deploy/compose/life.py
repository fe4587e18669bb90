"""One life of a process: its keeper, and what is heard of it."""

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

from deploy.compose.family import MARK, descendants
from deploy.compose.keeper import CHANNEL
from deploy.compose.stack_file import ProcessSpec
from services.bus.process_stat import ProcessStat

NAMESPACE = "ZENFI_NAMESPACE"
"""Environment variable: the Zenoh namespace in which the processes of a stack meet."""

_DATAGRAM_BYTES = 1 << 16
_ROOT = Path(__file__).parents[2]
# Isolated and without site packages, so that the process's environment, which is the keeper's as well,
# cannot change how the keeper runs.
_KEEPER = (
    "-I",
    "-S",
    "-c",
    f"import sys; sys.path.insert(0, {str(_ROOT)!r}); from deploy.compose.keeper import main; main()",
)


def environment(spec: ProcessSpec, folder: Path, namespace: str) -> dict[str, str]:
    """What a process of the stack in ``folder`` finds: ours, where it belongs to, what it declares.

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


class Life:
    """A keeper with its process. ``output`` is where all that they write can be read.

    ``pid`` is the process's, 0 until it runs; ``status`` stays None until its whole family is gone.
    """

    def __init__(self, number: int, spec: ProcessSpec, environment: Mapping[str, str]) -> None:
        self.number = number
        self._since_s = time.monotonic()
        self.spec = spec
        self.pid = 0
        self.error = ""
        self.status: int | None = None
        self.killed = 0
        self.refused = 0
        self.channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel.setblocking(False)
        self.output, written = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        os.set_blocking(written, True)
        try:
            self.keeper = os.posix_spawn(
                sys.executable,
                [sys.executable, *_KEEPER, spec.folder, *spec.command],
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
        """How long it has lasted."""
        return time.monotonic() - self._since_s

    def send(self, number: int) -> None:
        """Have a signal sent to the process; one that is gone needs none."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.channel.send(str(number).encode())

    def kill(self) -> None:
        """Have the process and all its family killed."""
        self.send(signal.SIGKILL)

    def hear(self) -> bool:
        """Take in one report of the keeper; False once it tells nothing any more.

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
        return descendants(self.keeper)

    def close(self) -> None:
        """Free the descriptors; a keeper that still lives ends its family and itself."""
        self.channel.close()
        os.close(self.output)
