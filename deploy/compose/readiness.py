"""Looks for the signs that a process is ready."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from deploy.compose.bus import StackBus
from deploy.compose.life import Life
from services.bus.announce import start_ticks

PROBE_PAUSE_S = 0.1
_PROBE_S = 2.0


class Watch:
    """Calls ``ready`` once, when every sign that the process's declaration names has been seen."""

    def __init__(self, life: Life, bus: StackBus, ready: Callable[[], None]) -> None:
        self._life = life
        self._bus = bus
        self._ready = ready
        self._missing = set(life.spec.ready.signs)
        self._subscriber: Any = None
        self._probe: asyncio.Task[None] | None = None
        wanted = life.spec.ready
        if wanted.publishes:
            self._subscriber = bus.first_message(wanted.publishes, lambda: self._seen("publishes"))
        if wanted.http:
            self._probe = asyncio.create_task(self._until_it_answers(wanted.http))
        self.look_for_announcement()

    def look_for_announcement(self) -> None:
        """See whether the process has announced itself.

        Anybody on the bus may claim to be anybody: the pid must be of this life's family and have
        started when the claim says.
        """
        name = self._life.spec.ready.announces
        if name is None or "announces" not in self._missing:
            return
        family = self._life.family()
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
        """Look no more."""
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
