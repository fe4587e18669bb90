"""How many requests that change something are taken at once and a second."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from starlette.types import ASGIApp, Receive, Scope, Send

from dashboard.api.problems import answer

MOST_AT_ONCE = 16
"""Of the 40 threads that requests have, others stay free for who only reads."""

MOST_A_SECOND = 20.0
"""In the long run; a program that sends more for longer than a moment goes wrong, or is to wait."""

BURST = 200
"""Requests that may come at once after some time without any."""

CHANGING = ("POST", "PUT", "PATCH", "DELETE")


class RequestLimit:
    """Answers requests that change something with 429 while there are too many of them.

    A token bucket: a request takes one of at most ``BURST`` tokens, of which ``MOST_A_SECOND`` come back a
    second. ``Retry-After`` says when there will be one.
    """

    def __init__(self, app: ASGIApp, now: Callable[[], float] = time.monotonic) -> None:
        self._app, self._now = app, now
        self._at_once = 0
        self._tokens, self._counted_s = float(BURST), now()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or have it sent again later."""
        # Others than the owner reach no more than /login; they shall not use up what is the owner's.
        is_ours = scope["type"] == "http" and scope["path"].startswith("/api/")
        if not is_ours or scope["method"] not in CHANGING:
            await self._app(scope, receive, send)
            return
        now = self._now()
        self._tokens = min(BURST, self._tokens + (now - self._counted_s) * MOST_A_SECOND)
        self._counted_s = now
        if self._at_once >= MOST_AT_ONCE:
            await _later(1, f"{MOST_AT_ONCE} requests are being worked on")(scope, receive, send)
        elif self._tokens < 1:
            wait_s = math.ceil((1 - self._tokens) / MOST_A_SECOND)
            await _later(wait_s, f"more than {MOST_A_SECOND:g} requests a second")(scope, receive, send)
        else:
            self._tokens -= 1
            self._at_once += 1
            try:
                await self._app(scope, receive, send)
            finally:
                self._at_once -= 1


def _later(wait_s: int, why: str) -> ASGIApp:
    return answer(429, f"{why}: send it again in {wait_s} s", headers={"Retry-After": str(wait_s)})
