"""What a page learns from its browser: whether it is in front, and steps in the history.

A page that is not in front is neither computed for nor sent anything. What people choose within a page is an
entry of the history, which the browser's back button undoes.
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any
from urllib.parse import parse_qsl

from nicegui import ui
from nicegui.events import GenericEventArguments

from dashboard.web.components.frame import told

EVERY_S = 1.0

_TELL_FRONT = """
const tell = () => emitEvent('in_front', !document.hidden);
document.addEventListener('visibilitychange', tell);
if (document.hidden) tell();
"""

_TELL_ADDRESS = """
const tell = () => emitEvent('arrived', [location.search, history.state]);
window.addEventListener('popstate', tell);
tell();
"""


def while_in_front(*refreshes: Callable[[], Awaitable[None]]) -> None:
    """Call each of these every second, beside each other, as long as the page is in front."""
    timers = [ui.timer(EVERY_S, refresh) for refresh in refreshes]

    def turn(event: GenericEventArguments) -> None:
        for timer in timers:
            timer.active = bool(event.args)

    ui.on("in_front", turn)
    ui.run_javascript(_TELL_FRONT)


def push(address: str, kept: Any = None) -> None:
    """Have ``address`` follow on what was shown before; ``kept`` is told again whenever people are there."""
    ui.run_javascript(f"history.pushState({json.dumps(kept)}, '', {json.dumps(address)})")


def on_arrival(show: Callable[[Mapping[str, str], Any], Awaitable[None]]) -> None:
    """Tell ``show`` what the address asks for and what was kept: once now, then at each step back or on."""

    @told
    async def arrive(event: GenericEventArguments) -> None:
        search, kept = event.args
        await show(dict(parse_qsl(str(search).removeprefix("?"))), kept)

    ui.on("arrived", arrive)
    ui.run_javascript(_TELL_ADDRESS)
