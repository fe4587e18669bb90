"""Whether a page is in front of somebody. One that is not is neither reckoned for nor sent anything."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from nicegui import ui
from nicegui.events import GenericEventArguments

EVERY_S = 1.0

_TELL = """
const tell = () => emitEvent('in_front', !document.hidden);
document.addEventListener('visibilitychange', tell);
if (document.hidden) tell();
"""


def while_in_front(*refreshes: Callable[[], Awaitable[None]]) -> None:
    """Call each of these every second, beside each other, as long as the page is in front."""
    timers = [ui.timer(EVERY_S, refresh) for refresh in refreshes]

    def turn(event: GenericEventArguments) -> None:
        for timer in timers:
            timer.active = bool(event.args)

    ui.on("in_front", turn)
    ui.run_javascript(_TELL)
