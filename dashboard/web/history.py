"""The browser's history: what people choose within a page is an entry of it, which back undoes."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any
from urllib.parse import parse_qsl

from nicegui import ui
from nicegui.events import GenericEventArguments

from dashboard.web.frame import told

_TELL = """
const tell = () => emitEvent('arrived', [location.search, history.state]);
window.addEventListener('popstate', tell);
tell();
"""


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
    ui.run_javascript(_TELL)
