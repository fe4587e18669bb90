"""One campaign, live: what it has found so far, and every run of it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial

from nicegui import ui
from nicegui.events import GenericEventArguments
from starlette.requests import Request

from dashboard.analysis import tables
from dashboard.api.routes.campaigns import CampaignDetail
from dashboard.api.service import Service
from dashboard.campaigns.store.listing import RunQuery
from dashboard.campaigns.store.queries import CampaignEntry, UnknownCampaignError
from dashboard.web.components.breakdown import Breakdown, fill, show
from dashboard.web.components.browser import while_in_front
from dashboard.web.components.findings import QUALITY_TITLES, Findings, InjectionFindings
from dashboard.web.components.frame import REFUSED, find, frame, nothing, section, trouble
from dashboard.web.components.parts import minute
from dashboard.web.components.progress import Actions, Progress
from dashboard.web.components.quality_tables import (
    BESIDE_NOTE,
    QUALITY_NOTE,
    beside_table,
    quality_table,
)
from dashboard.web.components.runs_table import RunsTable, asked
from dashboard.web.components.views import Beside, WatchedCampaign, WatchedCampaigns

BOXES_NOTE = (
    "Boxes: smallest, quartiles and largest of the successful flights. Each dot is a flight, and opens it; "
    "triangles are missions that failed, up to where they ended."
)
FOUND_NOTE = "Each cell beside its golden twins: success with its interval, and what the flights can tell."
MOST_SENTENCES = 24
EXPORTS = (
    ("runs as CSV", "export?format=csv"),
    ("runs as Parquet", "export?format=parquet"),
    ("table as CSV", "table?format=csv"),
    ("table as JSON", "table?format=json"),
)


def register(service: Service) -> None:
    """Declare the page of a campaign."""
    campaigns = WatchedCampaigns(service)

    @ui.page("/campaigns/{label}", response_timeout=60)
    async def page(label: str, request: Request) -> None:
        with frame(label):
            campaign = await find(service, label)
            if campaign is None:
                return
            state = ui.column().classes("section")
            with ui.column().classes("section parts") as content:
                shown = CampaignPage(
                    service, campaign, campaigns.of(campaign.label), asked(request.query_params)
                )
            ways = [partial(_told, state, content, one) for one in (shown.refresh, shown.refresh_more)]
            await ways[0]()
            while_in_front(*ways)


async def _told(state: ui.column, content: ui.column, refresh: Callable[[], Awaitable[None]]) -> None:
    """Bring a page up to date; say so where that cannot be, and try again at the next tick."""
    try:
        await refresh()
    except UnknownCampaignError:
        content.set_visibility(False)
        state.clear()
        with state:
            trouble("This campaign was deleted.", "The page Campaigns has all that there are.")
    except REFUSED as error:
        state.clear()
        with state:
            trouble(str(error), "What is shown below may be old. This page tries again by itself.")
    else:
        if state.default_slot.children:
            state.clear()


class CampaignPage:
    """The content of the page of a campaign."""

    def __init__(
        self, service: Service, campaign: CampaignEntry, watched: WatchedCampaign, query: RunQuery
    ) -> None:
        self._service, self._campaign, self._watched = service, campaign, watched
        self._findings: Findings | None = None
        self._injections: InjectionFindings | None = None
        self._beside: Beside | None = None
        self._head()
        with section("What was found", FOUND_NOTE, anchor="found"):
            self._found = ui.column().classes("section")
            with self._found:
                nothing("Being computed.", "With thousands of flights the intervals take some seconds.")
        with section("Quality of flight", QUALITY_NOTE):
            self._quality = quality_table()
            with ui.element("div").classes("triple"):
                self._success, self._outcomes = self._chart("Success, %"), self._chart("Outcome of missions")
                with ui.column().classes("section") as self._nodes_place:
                    self._nodes = self._chart("Outcome of the injected nodes")
        with section("Beside golden twins", BESIDE_NOTE):
            self._beside_state = ui.column().classes("section")
            with self._beside_state:
                nothing("Being computed.", "With thousands of flights the intervals take some seconds.")
            self._beside_table = beside_table()
            self._beside_table.set_visibility(False)
        with section("Flights", BOXES_NOTE, anchor="flights"):
            self._sampled = ui.label().classes("note")
            with ui.element("div").classes("triple"):
                self._boxes = [self._chart(title) for title in QUALITY_TITLES]
        with section("What was corrupted", anchor="struck"):
            self._breakdown = Breakdown()
        with section("Runs", anchor="runs"):
            self._runs = RunsTable(service, campaign, watched, query)

    async def refresh(self) -> None:
        """Show the newest progress and figures."""
        status = await self._watched.status()
        self._progress.show(status.detail, status.left, status.detail.trouble)
        self._actions.show(status.detail.phase)
        self._kept.set_text(_kept(status.detail))
        findings = await self._watched.findings()
        if findings is not self._findings:
            self._findings = findings
            self._draw(findings)
            await self._runs.refresh()

    async def refresh_more(self) -> None:
        """The same for what takes longer to compute."""
        injections = await self._watched.injections()
        if injections is not self._injections:
            self._injections = injections
            self._breakdown.show(injections)
        beside = await self._watched.beside()
        if beside is self._beside:
            return
        self._beside = beside
        self._tell(beside.found)
        fill(self._beside_table, beside.rows)
        self._beside_table.set_visibility(bool(beside.rows))
        self._beside_state.clear()
        if not beside.rows:
            with self._beside_state:
                nothing("No pairs yet.", "Every flight with a fault is set beside its twin without one.")

    def _tell(self, found: list[str]) -> None:
        """A sentence for each cell; of very many the first."""
        self._found.clear()
        with self._found:
            with ui.element("ul"):
                for sentence in found[:MOST_SENTENCES]:
                    with ui.element("li"):
                        ui.label(sentence)
            if len(found) > MOST_SENTENCES:
                ui.label(f"The table below has {len(found) - MOST_SENTENCES} cells more.").classes("note")

    def _head(self) -> None:
        label = self._campaign.label
        with ui.element("article").classes("card"):
            with ui.row().classes("card-head"):
                ui.label(f"asked for at {minute(self._campaign.created)}").classes("note")
                ui.space()
                self._actions = Actions(self._service, label, lambda: ui.navigate.to("/"))
            self._progress = Progress()
            with ui.row().classes("links"):
                for name, path in EXPORTS:
                    ui.link(name, f"/api/v1/campaigns/{label}/{path}").props("download")
                ui.link("compare", f"/compare?first={label}")
            self._kept = ui.label().classes("note")

    def _chart(self, title: str) -> ui.echart:
        with ui.column().classes("section"):
            ui.label(title).classes("caption")
            return ui.echart({}).classes("chart").on("componentClick", self._open, ["data"])

    def _open(self, event: GenericEventArguments) -> None:
        data = event.args["data"]
        if isinstance(data, dict) and "run" in data:
            ui.navigate.to(f"/campaigns/{self._campaign.label}/runs/{int(data['run'])}")

    def _draw(self, findings: Findings) -> None:
        fill(self._quality, findings.quality)
        show(self._success, findings.success)
        show(self._outcomes, findings.outcomes)
        for chart, boxes in zip(self._boxes, findings.boxes, strict=True):
            show(chart, boxes)
        self._sampled.set_text(findings.sampled)
        self._sampled.set_visibility(bool(findings.sampled))
        self._nodes_place.set_visibility(findings.nodes is not None)
        if findings.nodes is not None:
            show(self._nodes, findings.nodes)


def _kept(status: CampaignDetail) -> str:
    kept = [f"{one.runs} {fate} ({one.bytes / 1e6:.1f} MB)" for fate, one in status.files.items()]
    told = [f"files of runs: {', '.join(kept)}"] if kept else []
    return "; ".join(told + ([tables.replays(status.replays)] if status.replays else []))
