"""Two campaigns, or the arms of one, side by side: flights of one seed are pairs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from urllib.parse import urlencode

from nicegui import ui

from dashboard.api.service import Service
from dashboard.campaigns.results.compare import Comparison, side_by_side
from dashboard.campaigns.results.summary import CellSummary, summary
from dashboard.campaigns.store.queries import CampaignEntry, UnknownCampaignError
from dashboard.web.charts import charts
from dashboard.web.components import browser
from dashboard.web.components.breakdown import draw
from dashboard.web.components.frame import REFUSED, absent, ask, frame, nothing, plain, section, trouble
from dashboard.web.components.quality_tables import (
    BESIDE_NOTE,
    QUALITY_NOTE,
    beside_rows,
    beside_table,
    quality_rows,
    quality_table,
)

CHOICES = 200
"""The newest campaigns, among which one chooses; an older one can stand in the address."""

TWINS = "golden twins"


def register(service: Service) -> None:
    """Declare the page that compares campaigns."""

    @ui.page("/compare", response_timeout=60)
    async def page(first: str = "", second: str = "", arm: str = "") -> None:
        with frame("Compare"):
            try:
                known = [one.label for one in await ask(service.store.newest, CHOICES)]
            except REFUSED as error:
                trouble(str(error), "Load this page again once that is put right.")
                return
            if not known:
                nothing("No campaigns yet.", "There is nothing to compare.", ("Start one", "/new"))
                return
            page = _Page(service, known)
            chosen = first or known[0], second, arm
            ui.navigate.history.replace(_address(*chosen))
            await page.show(*chosen)
            browser.on_arrival(page.arrive)


class _Page:
    def __init__(self, service: Service, known: list[str]) -> None:
        self._service, self._known = service, known
        self._choice = ui.row().classes("filters")
        self._body = ui.column().classes("section parts")
        self._shown = ("", "", "")

    async def arrive(self, parameters: Mapping[str, str], _: object) -> None:
        """Show what people have gone back or forward to."""
        first, second, arm = (parameters.get(name, "") for name in ("first", "second", "arm"))
        wanted = first or self._known[0], second, arm
        if wanted != self._shown:
            await self.show(*wanted)

    async def _turn_to(self, first: str, second: str, arm: str) -> None:
        """Show what people have chosen, as an entry of the browser's history."""
        browser.push(_address(first, second, arm))
        await self.show(first, second, arm)

    async def show(self, first: str, second: str, arm: str) -> None:
        """One campaign beside another, an arm of its own, or its golden twins."""
        self._shown = first, second, arm
        self._body.clear()
        try:
            found = await ask(self._service.store.find, first)
            other = await ask(self._service.store.find, second) if second else None
            self._choose(found, second, arm)
            with self._body:
                wait = ui.label("Being computed: with thousands of flights that takes some seconds.")
                wait.props('role="status"').classes("note")
            compared = await ask(side_by_side, self._service.store, found, other, arm or None)
            summaries = {
                one.label: await ask(summary, self._service.store, one) for one in (found, other) if one
            }
        except REFUSED as error:
            self._choose(None, second, arm)
            self._body.clear()
            with self._body:
                if isinstance(error, UnknownCampaignError):
                    absent(plain(error), "Choose others above.")
                else:
                    trouble(str(error), "Choose others above.")
            return
        self._body.clear()
        with self._body:
            _beside(compared)
            _qualities(summaries)

    def _choose(self, found: CampaignEntry | None, second: str, arm: str) -> None:
        self._choice.clear()
        first = found.label if found is not None else self._known[0]
        arms = [f"arm {one.name}" for one in found.spec.arms] if found is not None else []
        others = [label for label in self._known if label != first]
        beside = f"arm {arm}" if arm else second or TWINS

        async def choose_first(event: Any) -> None:
            await self._turn_to(event.value, "", "")

        async def choose_other(event: Any) -> None:
            value = str(event.value)
            if value in arms:
                await self._turn_to(first, "", value.removeprefix("arm "))
            else:
                await self._turn_to(first, "" if value == TWINS else value, "")

        with self._choice:
            labels = list(dict.fromkeys([first, *self._known]))
            ui.select(labels, value=first, label="campaign", on_change=choose_first, with_input=True).props(
                "outlined dense"
            ).classes("filter")
            options = list(dict.fromkeys([TWINS, *arms, *others, beside]))
            ui.select(options, value=beside, label="beside", on_change=choose_other, with_input=True).props(
                "outlined dense"
            ).classes("filter")


def _address(first: str, second: str, arm: str) -> str:
    chosen = {"first": first, "second": second, "arm": arm}
    return f"/compare?{urlencode({name: one for name, one in chosen.items() if one})}"


def _beside(compared: list[Comparison]) -> None:
    reference = compared[0].reference if compared else ""
    with section(f"Beside {reference}" if reference else "Differences", BESIDE_NOTE):
        if not compared:
            nothing(
                "No flights are pairs.",
                "Pairs are flights of one seed: with their twins, in two arms, or in cells of the same name.",
            )
            return
        beside_table().rows = beside_rows(compared)
        with ui.element("div").classes("pair"):
            _forest("Change of success, points", [_success(one) for one in compared])
            _forest("Change of flight time, median, s", [_time(one) for one in compared])


def _forest(title: str, changes: list[charts.ChartChange]) -> None:
    with ui.column().classes("section"):
        ui.label(title).classes("caption")
        draw(ui.echart({}).classes("chart"), charts.forest(changes, title, title), len(changes))


def _success(one: Comparison) -> charts.ChartChange:
    value = None if one.success_difference is None else 100 * one.success_difference
    low, high = one.success_interval
    return charts.ChartChange(one.cell, value, 100 * low, 100 * high)


def _time(one: Comparison) -> charts.ChartChange:
    interval = one.flight_time_s.median_interval
    value = one.flight_time_s.median if interval is not None else None
    low, high = interval if interval is not None else (0.0, 0.0)
    return charts.ChartChange(one.cell, value, low, high)


def _qualities(summaries: dict[str, list[CellSummary]]) -> None:
    for label, lines in summaries.items():
        with section(label, QUALITY_NOTE):
            ui.link("open", f"/campaigns/{label}")
            quality_table().rows = quality_rows(lines)
