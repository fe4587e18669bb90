"""The signs by which a process shows that it is ready, and later that it still works."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from deploy.compose.bus import StackBus
from deploy.compose.process import SupervisedProcess
from deploy.compose.stack_file import Liveness
from services.bus.announce import start_ticks

PROBE_PAUSE_S = 0.1
ANSWER_S = 2.0
"""How long a server may take to say that it is ready."""

_SUCCESS = re.compile(rb"HTTP/1\.[01] 2\d\d\b")


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
        """Check whether the process has announced itself on the bus."""
        name = self._process.spec.ready.announces
        if name is None or "announces" not in self._missing:
            return
        if is_announced(name, self._process, self._bus):
            self._seen("announces")

    async def _until_it_answers(self, url: str) -> None:
        while not await answers(url, ANSWER_S):
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


class LivenessWatch:
    """Probes a process that is ready, and calls ``dead`` once, with the reason, when too many probes failed.

    ``failed`` counts the failed probes in a row.
    """

    def __init__(
        self, process: SupervisedProcess, wanted: Liveness, bus: StackBus, dead: Callable[[str], None]
    ) -> None:
        self._process, self._wanted, self._bus, self._dead = process, wanted, bus, dead
        self._heard = False
        self.failed = 0
        self._subscriber: Any = None
        if wanted.publishes:
            self._subscriber = bus.first_message(wanted.publishes, self._hear)
        self._probing = asyncio.create_task(self._probe())

    async def _probe(self) -> None:
        while self.failed < self._wanted.failures:
            await asyncio.sleep(self._wanted.every_s)
            missing = await self._missing()
            self.failed = self.failed + 1 if missing else 0
        self._dead(f"{self.failed} probes in a row failed: {missing}")

    async def _missing(self) -> str:
        """The first sign that is missing; nothing if all were seen."""
        wanted = self._wanted
        heard, self._heard = self._heard, False
        if wanted.http and not await answers(wanted.http, wanted.timeout_s):
            return f"{wanted.http} does not answer"
        if wanted.announces and not is_announced(wanted.announces, self._process, self._bus):
            return f"{wanted.announces} is not announced"
        if wanted.publishes and not heard:
            return f"no message on {wanted.publishes}"
        return ""

    def _hear(self) -> None:
        self._heard = True

    def close(self) -> None:
        """Stop probing and listening for messages of the process."""
        self._probing.cancel()
        if self._subscriber is not None:
            self._subscriber.undeclare()
            self._subscriber = None


def is_announced(name: str, process: SupervisedProcess, bus: StackBus) -> bool:
    """Whether a process of this family is announced under a name.

    Anybody on the bus may claim to be anybody: the pid must be of the family and have started when the
    claim says.
    """
    family = process.family()
    for claim in bus.announcements(name):
        with contextlib.suppress(OSError):
            if claim.pid in family and start_ticks(claim.pid) == claim.start_ticks:
                return True
    return False


async def answers(url: str, within_s: float) -> bool:
    """Whether a GET of ``url`` is answered with 2xx in time."""
    parts = urlsplit(url)
    target = f"{parts.path or '/'}{'?' if parts.query else ''}{parts.query}"
    asked = f"GET {target} HTTP/1.1\r\nHost: {parts.netloc}\r\nConnection: close\r\n\r\n"
    # No thread: one that waits for a server that hangs would outlive the watch, and keep the supervisor.
    try:
        async with asyncio.timeout(within_s):
            reader, writer = await asyncio.open_connection(parts.hostname, parts.port or 80)
            try:
                writer.write(asked.encode())
                return _SUCCESS.match(await reader.readline()) is not None
            finally:
                writer.close()
    except (OSError, ValueError):  # nobody there, too late, or a line without end
        return False
