"""The runs of a campaign, a page at a time; what is shown stands in the address."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args
from urllib.parse import urlencode

from nicegui import ui
from pydantic import ValidationError

from dashboard.api.service import Service
from dashboard.campaigns.spec import cells
from dashboard.campaigns.state_machine import RunPhase
from dashboard.campaigns.store.listing import Order, RunLine, RunListing, RunQuery, run_page
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.web.components import browser
from dashboard.web.components.breakdown import fill
from dashboard.web.components.frame import ask, told
from dashboard.web.components.views import WatchedCampaign
from services.models.outcome import MissionResult, NodeResult

PAGE = 25
COLUMNS: tuple[tuple[str, str], ...] = (
    ("id", "run"),
    ("arm", "arm"),
    ("world", "world"),
    ("fault", "fault"),
    ("seed", "seed"),
    ("phase", "phase"),
    ("result", "result"),
    ("node_result", "injected node"),
    ("flight_time_s", "time, s"),
    ("distance_m", "distance, m"),
    ("energy_kj", "energy, kJ"),
    ("replans", "replans"),
    ("min_clearance_m", "clearance, m"),
)
NUMBERS = ("seed", "flight_time_s", "distance_m", "energy_kj", "replans", "min_clearance_m")
SORTED = get_args(Order)
_LINK = '<q-td :props="props"><a :href="props.row.href">{{ props.value }}</a></q-td>'


def asked(parameters: Mapping[str, str]) -> RunQuery:
    """What the address asks for; what is none of it is left out."""
    try:
        given = {name: value for name, value in parameters.items() if name in RunQuery.model_fields and value}
        return RunQuery.model_validate({"limit": PAGE} | given, strict=False)
    except ValidationError:
        return RunQuery(limit=PAGE)


class RunsTable:
    """Filters, the table, and ways to the next page; :meth:`refresh` brings it up to date."""

    def __init__(
        self, service: Service, campaign: CampaignEntry, watched: WatchedCampaign, query: RunQuery
    ) -> None:
        self._service, self._campaign, self._watched, self._query = service, campaign, watched, query
        self._before: list[str | None] = []
        self._filters: dict[str, ui.select] = {}
        order = cells(campaign.spec)
        self._choices: dict[str, list[str]] = {
            "arm": list(dict.fromkeys(cell.arm for cell in order)),
            "world": list(dict.fromkeys(cell.world for cell in order)),
            "fault": [name for name in dict.fromkeys(cell.fault for cell in order) if name],
            "phase": list(get_args(RunPhase)),
            "result": list(get_args(MissionResult)),
            "node_result": list(get_args(NodeResult)),
        }
        with ui.row().classes("filters").props('role="search"'):
            for name, choices in self._choices.items():
                if name in ("phase", "result", "node_result") or len(choices) > 1:
                    self._filter(name, choices)
            labels = {name: label for name, label in COLUMNS if name in SORTED}
            change = told(self._sort_by)
            self._sorted = ui.select(labels, label="sorted by", value=query.sort, on_change=change)
            self._sorted.props("dense outlined options-dense").classes("filter")
            self._descending = ui.checkbox("largest first", value=query.descending, on_change=change)
            self._descending.props('aria-label="largest first"')
        self._table = self._make_table()
        with ui.row().classes("toolbar"):
            self._back = ui.button("Previous", on_click=told(self._go_back)).props("flat no-caps")
            self._on = ui.button("Next", on_click=told(self._go_on)).props("flat no-caps")
            self._count = ui.label().classes("note").props('role="status"')
        self._page: RunListing | None = None
        self._arrived = self._turned = False
        browser.on_arrival(self._arrive)

    async def refresh(self) -> None:
        """What runs that have ended since have changed."""
        query = self._query
        page = await self._watched.runs(query)
        if query is self._query:  # else another page was turned to meanwhile
            self._show(page)

    def _show(self, page: RunListing) -> None:
        self._page = page
        fill(self._table, [self._row(run) for run in page.runs])
        self._allow_steps()
        self._on.set_enabled(page.next is not None)
        self._count.set_text(f"{len(page.runs)} runs here" if page.runs else "No run is like this.")

    def _allow_steps(self) -> None:
        """A step back needs what the browser kept: the pages before this one."""
        self._back.set_enabled(self._arrived and self._query.after is not None)

    async def _display(self) -> None:
        """Show what is asked for, unless people have asked for something else meanwhile."""
        query = self._query
        page = await ask(run_page, self._service.store, self._campaign, query)
        if query is self._query:
            self._show(page)

    def _make_table(self) -> ui.table:
        shown = [one for one in COLUMNS if one[0] not in self._choices or len(self._choices[one[0]]) > 1]
        columns = [
            {
                "name": name,
                "label": label,
                "field": name,
                "sortable": name in SORTED,
                "align": "right" if name in NUMBERS else "left",
            }
            for name, label in shown
        ]
        table = ui.table(columns=columns, rows=[], row_key="id", pagination=self._order()).classes(
            "figures runs"
        )
        table.props("flat dense binary-state-sort hide-pagination")
        # Names as they are: Vue puts them in as text.
        table.add_slot("body-cell-id", _LINK)
        table.on("request", told(self._sort), ["pagination"])
        return table

    def _filter(self, name: str, choices: list[str]) -> None:
        label = dict(COLUMNS)[name]

        async def choose(event: Any) -> None:
            if event.value != getattr(self._query, name):  # else it follows the address
                await self._ask(**{name: event.value})

        select = self._filters[name] = ui.select(
            choices, label=label, value=getattr(self._query, name), clearable=True, on_change=told(choose)
        )
        select.props("dense outlined options-dense").classes("filter")

    def _order(self) -> dict[str, object]:
        """What Quasar is told; with a number of rows it leaves sorting to us."""
        return {
            "sortBy": self._query.sort,
            "descending": self._query.descending,
            "rowsPerPage": self._query.limit,
            "rowsNumber": self._query.limit,
        }

    async def _sort(self, event: Any) -> None:
        wanted = event.args["pagination"]
        self._sorted.set_value(wanted["sortBy"] or "id")
        self._descending.set_value(bool(wanted["descending"]))

    async def _sort_by(self) -> None:
        order = self._sorted.value, self._descending.value
        if order != (self._query.sort, self._query.descending):  # else it follows the address
            await self._ask(sort=order[0], descending=order[1])
            self._table.pagination = self._order()

    async def _ask(self, **changes: object) -> None:
        await self._turn_to([], **changes, after=None)

    async def _go_on(self) -> None:
        if self._page is not None and self._page.next is not None:
            await self._turn_to([*self._before, self._query.after], after=self._page.next)

    async def _go_back(self) -> None:
        *before, after = self._before or [None]
        await self._turn_to(before, after=after)

    async def _arrive(self, parameters: Mapping[str, str], kept: Any) -> None:
        """Show what people have gone back or forward to; ``kept`` are the pages before it.

        The first time it is what the page was opened with: old, if people were faster.
        """
        is_first, self._arrived = not self._arrived, True
        self._allow_steps()
        if is_first and self._turned:
            return
        self._before = kept if isinstance(kept, list) else []
        query = asked(parameters)
        if query == self._query:
            return
        self._query = query
        for name, select in self._filters.items():
            select.set_value(getattr(query, name))
        self._sorted.set_value(query.sort)
        self._descending.set_value(query.descending)
        self._table.pagination = self._order()
        await self._display()

    async def _turn_to(self, before: list[str | None], **changes: object) -> None:
        """Show other runs, as an entry of the browser's history; ``before``: the pages before these."""
        self._turned, self._before = True, before
        self._query = RunQuery.model_validate(self._query.model_dump() | changes)
        chosen = self._query.model_dump(mode="json", exclude_defaults=True, exclude={"limit"})
        if self._query.limit != PAGE:
            chosen["limit"] = self._query.limit
        browser.push(f"/campaigns/{self._campaign.label}?{urlencode(chosen)}#runs", before)
        await self._display()

    def _row(self, run: RunLine) -> dict[str, object]:
        row: dict[str, object] = run.model_dump(exclude={"result"})
        if run.result is not None:
            for name, _ in COLUMNS:
                value = getattr(run.result, name, row.get(name))
                row[name] = f"{value:.2f}" if isinstance(value, float) else value
        return row | {"href": f"/campaigns/{self._campaign.label}/runs/{run.id}"}
