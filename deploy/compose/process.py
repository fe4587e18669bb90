"""One start of a process under its reaper: what the reaper reports, and the signs that it is ready."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from deploy.compose.bus import StackBus
from deploy.compose.process_tree import MARK, NAMESPACE, descendants
from deploy.compose.reaper import CHANNEL
from deploy.compose.stack_file import ProcessSpec
from services.bus.announce import start_ticks
from services.system.process_stat import ProcessStat

_DATAGRAM_BYTES = 1 << 16
# Isolated: the process's environment, which is the reaper's as well, cannot change how the reaper runs.
_REAPER = ("-I", "-m", "deploy.compose.reaper")


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
            self.reaper = os.posix_spawn(
                sys.executable,
                [sys.executable, *_REAPER, spec.folder, *spec.command],
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


PROBE_PAUSE_S = 0.1
_PROBE_S = 2.0


class ReadinessWatch:
    """Calls ``ready`` once, when every sign that the process's declaration names has been seen."""

    def __init__(self, process: SupervisedProcess, bus: StackBus, ready: Callable[[], None]) -> None:
        self._process = process
        self._bus = bus
        self._ready = ready
        self._missing = set(process.spec.ready.signs)
        self._subscriber: Any = None
        self._probe: asyncio.Task[None] | None = None
        wanted = process.spec.ready
        if wanted.publishes:
            self._subscriber = bus.first_message(wanted.publishes, lambda: self._seen("publishes"))
        if wanted.http:
            self._probe = asyncio.create_task(self._until_it_answers(wanted.http))
        self.look_for_announcement()

    def look_for_announcement(self) -> None:
        """Check whether the process has announced itself on the bus.

        Anybody on the bus may claim to be anybody: the pid must be of this process's family and have
        started when the claim says.
        """
        name = self._process.spec.ready.announces
        if name is None or "announces" not in self._missing:
            return
        family = self._process.family()
        for claim in self._bus.announcements(name):
            with contextlib.suppress(OSError):
                if claim.pid in family and start_ticks(claim.pid) == claim.start_ticks:
                    self._seen("announces")
                    return

    async def _until_it_answers(self, url: str) -> None:
        while not await asyncio.to_thread(answers, url):
            await asyncio.sleep(PROBE_PAUSE_S)
        self._seen("http")

    def _seen(self, sign: str) -> None:
        if sign not in self._missing:
            return
        self._missing.remove(sign)
        if not self._missing:
            self.close()
            self._ready()

    def close(self) -> None:
        """Stop watching for signs of readiness."""
        self._missing.clear()
        if self._subscriber is not None:
            self._subscriber.undeclare()
            self._subscriber = None
        if self._probe is not None:
            self._probe.cancel()
            self._probe = None


def answers(url: str) -> bool:
    """Whether a GET of ``url`` is answered with 2xx."""
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port or 80, timeout=_PROBE_S)
    try:
        connection.request("GET", f"{parts.path or '/'}{'?' if parts.query else ''}{parts.query}")
        return 200 <= connection.getresponse().status < 300
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()
