"""Campaigns at a glance: phase, progress, time left, success per arm; and their commands."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from nicegui import ui

from dashboard.api.service import Service
from dashboard.campaigns.statistics.proportions import wilson
from dashboard.campaigns.store.listing import LARGEST_ID, ArmLine, CampaignLine, arm_lines, campaign_page
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.web.components.browser import while_in_front
from dashboard.web.components.frame import REFUSED, ask, frame, nothing, trouble
from dashboard.web.components.progress import Actions, Progress, time_left
from dashboard.web.components.views import LOOK_S, SharedValue, news

AT_ONCE = 20
"""Campaigns a page."""


@dataclass(frozen=True, slots=True)
class Glance:
    """What the card of a campaign shows."""

    line: CampaignLine
    found: CampaignEntry
    arms: list[ArmLine]
    left: str


@dataclass(frozen=True, slots=True)
class Overview:
    """A page of campaigns, the newest first; ``older`` asks for the next."""

    glances: list[Glance]
    older: int | None


def overview(service: Service, before: int | None) -> Overview:
    """Read the newest campaigns for the cards."""
    page = campaign_page(service.store, AT_ONCE, before)
    found = {one.label: one for one in service.store.newest(AT_ONCE, before)}
    arms = arm_lines(service.store, list(found.values()))
    return Overview(
        [
            Glance(
                line,
                found[line.campaign],
                arms[line.campaign],
                time_left(service, found[line.campaign].spec, line),
            )
            for line in page.campaigns
            if line.campaign in found
        ],
        page.next,
    )


class Card:
    """The card of a campaign in the list."""

    def __init__(self, service: Service, label: str) -> None:
        with ui.element("article").classes("card") as self._card:
            with ui.row().classes("card-head"):
                ui.link(label, f"/campaigns/{label}").classes("card-name")
                self._actions = Actions(service, label, self._card.delete)
            self._progress = Progress()
            self._arms = ui.column().classes("arms")
        self._shown: list[ArmLine] | None = None

    def show(self, glance: Glance) -> None:
        """Show the newest values on the card."""
        self._progress.show(glance.line, glance.left)
        self._actions.show(glance.line.phase)
        if glance.arms != self._shown:
            self._shown = glance.arms
            self._arms.clear()
            with self._arms:
                _arms(glance.arms)


def _arms(arms: Sequence[ArmLine]) -> None:
    if arms:
        ui.label("missions that succeeded, with 95 % intervals").classes("note")
    for arm in arms:
        low, high = wilson(arm.successes, arm.flown)
        between = f"{100 * low:.0f} to {100 * high:.0f} %"
        with ui.element("div").classes("arm"):
            ui.label(arm.arm).classes("arm-name").props["title"] = arm.arm
            with ui.element("div").classes("arm-bar").props('aria-hidden="true"'):
                part = ui.element("div").classes("arm-part")
                part.style(f"width: {100 * arm.successes / arm.flown:.1f}%")
                interval = ui.element("div").classes("arm-interval")
                interval.style(f"left: {100 * low:.1f}%; width: {100 * (high - low):.1f}%")
            ui.label(f"{arm.successes} of {arm.flown} ({between})").classes("arm-count").props(
                f'aria-label="{arm.successes} of {arm.flown} missions succeeded, {between}"'
            )


def register(service: Service) -> None:
    """Declare the page that lists campaigns."""
    newest = SharedValue(lambda: overview(service, None))

    @ui.page("/", response_timeout=30)
    async def page(before: int | None = None) -> None:
        older = before if before is not None and 0 <= before <= LARGEST_ID else None

        async def look() -> Overview:
            if older is None:
                return await newest.get((news(service.event_bus), time.monotonic() // LOOK_S))
            return await ask(overview, service, older)

        with frame("Campaigns"):
            with ui.row().classes("toolbar"):
                ui.link("New campaign", "/new").classes("button-link")
                if older is not None:
                    ui.link("Newest", "/")
            shown = _Cards(service, look)
            await shown.refresh()
            while_in_front(shown.refresh)


class _Cards:
    def __init__(self, service: Service, look: Callable[[], Awaitable[Overview]]) -> None:
        self._service, self._look = service, look
        self._state = ui.column().classes("section")
        self._grid = ui.element("div").classes("cards")
        self._older = ui.row()
        self._cards: dict[str, Card] = {}

    async def refresh(self) -> None:
        """Show the newest values on all cards."""
        try:
            seen = await self._look()
        except REFUSED as error:
            self._state.clear()
            with self._state:
                trouble(str(error), "What is shown below may be old. This page tries again by itself.")
            return
        if self._state.default_slot.children:
            self._state.clear()
        if [glance.line.campaign for glance in seen.glances] != list(self._cards):
            self._lay_out(seen)
        for glance in seen.glances:
            self._cards[glance.line.campaign].show(glance)
        if not seen.glances:
            with self._state:
                nothing(
                    "No campaigns yet.",
                    "Start one here, or at the command line: zenfi campaign run demo",
                    ("Start the demo", "/new?preset=demo"),
                )

    def _lay_out(self, seen: Overview) -> None:
        self._grid.clear()
        with self._grid:
            labels = [glance.line.campaign for glance in seen.glances]
            self._cards = {label: Card(self._service, label) for label in labels}
        self._older.clear()
        if seen.older is not None:
            with self._older:
                ui.link("Older campaigns", f"/?before={seen.older}")
