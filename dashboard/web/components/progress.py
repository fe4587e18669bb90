"""Where a campaign stands, for people: its phase, how far it is, how long it will take, what can be done."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import lru_cache

from fastapi import Response
from nicegui import ui

from dashboard.analysis.tables import forecast as in_words
from dashboard.api.routes import campaigns as api
from dashboard.api.service import Service
from dashboard.campaigns.forecast import forecast
from dashboard.campaigns.spec import CampaignSpec
from dashboard.campaigns.store.listing import CampaignLine
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.web.components.frame import ask, confirmed, told

ACTIONS: dict[str, Callable[[Service, CampaignEntry], object]] = {
    "pause": api.pause_campaign,
    "resume": api.resume_campaign,
    "cancel": api.cancel_campaign,
    "delete": api.delete_campaign,
}
"""What the API does; ``clone`` leads to a page of its own."""

ASKED = {
    "cancel": "Cancel {label}? What was flown stays; what was not will never be.",
    "delete": "Delete {label} with all its runs, results and files? They cannot be had back.",
}

OFFERED = {
    "queued": ("pause", "cancel"),
    "running": ("pause", "cancel"),
    "paused": ("resume", "cancel"),
    "interrupted": ("resume", "cancel"),
    "failed": ("resume", "cancel"),
}
"""By phase; cloning and deleting always are."""

ICONS = {
    "pause": "pause",
    "resume": "play_arrow",
    "cancel": "block",
    "clone": "content_copy",
    "delete": "delete",
}


ANEW = 10
"""After so many flights more, what is left is computed from how long they took."""


@lru_cache(maxsize=256)
def _hours(spec: str, service: Service, _tens: int) -> float:
    return forecast(CampaignSpec.model_validate_json(spec), service.store, len(os.sched_getaffinity(0))).hours


def time_left(service: Service, spec: CampaignSpec, line: CampaignLine) -> str:
    """How long what is left of a campaign will take, as flights took here; empty if nobody flies it."""
    if line.phase not in ("running", "queued"):
        return ""
    left = (line.runs - line.done - line.failed) / max(line.runs, 1)
    minutes = 60 * left * _hours(spec.model_dump_json(), service, line.done // ANEW)
    if minutes >= 90:
        return f"about {minutes / 60:.1f} h left"
    return f"about {minutes:.0f} min left" if minutes >= 1.5 else "about a minute left"


class Progress:
    """Phase, bar and words; :meth:`show` brings them up to date. A run that is over is ``done`` (flown)."""

    def __init__(self, done: str = "flown") -> None:
        self._done = done
        with ui.row().classes("progress"):
            self._phase = ui.label().classes("phase")
            self._words = ui.label().classes("words")
        self._bar = ui.linear_progress(show_value=False, size="8px").props(
            f'aria-label="{done}" instant-feedback'
        )
        self._reason = ui.label().classes("reason")

    def show(self, line: CampaignLine, left: str, trouble: str = "") -> None:
        """Show the present progress of the campaign."""
        words = f", {line.failed} could not be flown" if line.failed else ""
        words += f", {left}" if left else ""
        self.show_counts(line.phase, line.done, line.runs, trouble or line.reason, words, line.failed)

    def show_counts(
        self, phase: str, done: int, runs: int, reason: str, words: str = "", failed: int = 0
    ) -> None:
        """Show how many of the runs are over; ``words`` follow on their number."""
        self._phase.set_text(phase)
        self._phase.classes(replace=f"phase phase-{phase}")
        self._words.set_text(f"{done} of {runs} {self._done}{words}")
        self._bar.set_value(round((done + failed) / max(runs, 1), 4))
        reason = reason if reason != phase else ""
        self._reason.set_text(reason)
        self._reason.set_visibility(bool(reason))


class Commands(ABC):
    """Buttons for what can be done with something in its phase; those ``always`` there come last."""

    def __init__(self, label: str, always: Sequence[str]) -> None:
        self._label, self._always = label, always
        with ui.row().classes("commands").props(f'role="group" aria-label="Commands for {label}"'):
            self._buttons = {name: self._button(name) for name in ("pause", "resume", "cancel", *always)}

    def show(self, phase: str) -> None:
        """Offer what goes with a phase."""
        offered = (*OFFERED.get(phase, ()), *self._always)
        for name, button in self._buttons.items():
            button.set_visibility(name in offered)

    def _button(self, name: str) -> ui.button:
        async def press() -> None:
            await self._act(name)

        button = ui.button(icon=ICONS[name], on_click=told(press)).props("flat round dense")
        return button.props(f'aria-label="{name}"').tooltip(name)

    @abstractmethod
    async def _act(self, name: str) -> None:
        """Do what the button of that name says."""


class Actions(Commands):
    """Buttons for what can be done with a campaign in its phase."""

    def __init__(self, service: Service, label: str, deleted: Callable[[], None]) -> None:
        self._service, self._deleted = service, deleted
        super().__init__(label, ("delete", "clone"))

    async def _act(self, name: str) -> None:
        if name == "clone":
            await self._clone()
            return
        question = ASKED.get(name)
        if question is not None and not await confirmed(
            question.format(label=self._label), name.capitalize()
        ):
            return
        campaign = await ask(self._service.store.find, self._label)
        await ask(ACTIONS[name], self._service, campaign)
        if name == "delete":
            self._deleted()

    async def _clone(self) -> None:
        """Fly the same again, once people have seen what that is."""
        spec = (await ask(self._service.store.find, self._label)).spec
        plan = await ask(forecast, spec, self._service.store, len(os.sched_getaffinity(0)))
        question = f"Fly {self._label} again, as a new campaign?"
        if await confirmed(question, "Fly", in_words(spec.name, plan), "primary"):
            made = await ask(api.create, self._service, spec, None, Response())
            ui.navigate.to(f"/campaigns/{made.label}")
