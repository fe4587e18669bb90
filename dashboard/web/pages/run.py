"""One run: injection, flight beside its golden twin, propagation of the fault; replay and recording."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from fastapi import Response
from nicegui import ui

from dashboard.analysis.why import why
from dashboard.api.problems import NotFoundError
from dashboard.api.routes.flights import NewFlight, create_flight
from dashboard.api.routes.recordings import Recordings, record_run, recordings
from dashboard.api.routes.runs import RunId, read_run, replay_run
from dashboard.api.service import Service
from dashboard.campaigns.flight_record import Result
from dashboard.campaigns.results.detection_effects import effect
from dashboard.campaigns.results.related_runs import RelatedRun, related_runs, same_flights
from dashboard.campaigns.spec import unprotected_arms
from dashboard.campaigns.store.listing import StoredRun
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.web.components.frame import REFUSED, absent, ask, find, frame, nothing, section, told, trouble
from dashboard.web.components.injection_card import injection_card
from dashboard.web.components.parts import facts, log, table
from dashboard.web.pages.live import address
from dashboard.web.pages.run_flight import flight_views, read_flights
from services.models.outcome import Outcome, QoF

LOG_BYTES = 6000


def register(service: Service) -> None:
    """Declare the page of a single run."""

    @ui.page("/campaigns/{label}/runs/{run}", response_timeout=60)
    async def page(label: str, run: RunId) -> None:
        with frame(f"{label}, run {run}"):
            campaign = await find(service, label)
            if campaign is None:
                return
            try:
                stored = await ask(read_run, service, campaign, run)
            except NotFoundError as error:
                way = "Open the campaign", f"/campaigns/{quote(campaign.label, safe='')}"
                absent(str(error), "The campaign's page has all its runs.", way)
                return
            except REFUSED as error:
                trouble(str(error), "Load this page again once that is put right.")
                return
            await RunPage(service, campaign, stored).draw()


class RunPage:
    """The content of the page of a run."""

    def __init__(self, service: Service, campaign: CampaignEntry, stored: StoredRun) -> None:
        self._service, self._campaign, self._stored = service, campaign, stored

    async def draw(self) -> None:
        """Draw every section of the page."""
        stored, outcome = self._stored, self._stored.outcome
        others = await ask(related_runs, self._service.store, self._campaign, stored.id)
        self._ways(others)
        if outcome is not None and outcome.injection is not None:
            with section("Why"), ui.element("div").classes("panel"):
                ui.label(why(outcome))
        with ui.element("div").classes("panels"):
            with section("What was asked for"):
                self._about(await ask(self._effect, others))
            if outcome is not None:
                _quality(outcome)
                _harm(outcome)
        if outcome is None:
            nothing(
                f"This run has no result: it is {stored.phase}.",
                stored.error or "Open this page again once it is flown.",
            )
            await self._logs()
            return
        self._buttons(outcome)
        self._answer = ui.column().classes("section")
        await self._flight(outcome, others)
        if outcome.injection is not None:
            with section("Injection"), ui.element("div").classes("panel"):
                injection_card(outcome.injection)
        with section("Nodes"):
            _nodes(outcome)
        await self._logs()

    def _ways(self, others: list[RelatedRun]) -> None:
        """To the campaign, and to the same flight in other arms."""
        with ui.row().classes("buttons"):
            ui.link(f"Campaign {self._campaign.label}", f"/campaigns/{quote(self._campaign.label, safe='')}")
            for one in others:
                ui.link(
                    f"the same in {one.arm}: {one.result or 'not flown'}",
                    f"/campaigns/{quote(self._campaign.label, safe='')}/runs/{one.id}",
                )

    def _effect(self, others: list[RelatedRun]) -> str:
        """What the detector made of the fault, in a word."""
        outcome = self._stored.outcome
        if outcome is None:
            return ""
        bare = unprotected_arms(self._campaign.spec).get(self._stored.arm)
        beside = next((one.id for one in others if one.arm == bare), None)
        other = None if beside is None else read_run(self._service, self._campaign, beside).outcome
        return effect(Result.of(outcome), Result.of(other) if other is not None else None) or ""

    def _about(self, made: str) -> None:
        stored, outcome = self._stored, self._stored.outcome
        facts(
            {
                "Arm": stored.arm,
                "World": stored.world,
                "Fault": stored.fault,
                "Number and seed": f"{stored.number}, {stored.seed}",
                "State": stored.phase,
                "Attempts": str(stored.attempts) if stored.attempts > 1 else "",
                "Error": stored.error,
                "Mission": f"{stored.spec.mission}, planner {stored.spec.planner}, {stored.spec.clock}",
                "Detector": _detector(stored),
                "The fault was": made,
                "Proven, not flown": outcome.proof.told if outcome is not None and outcome.proof else "",
            }
        )

    # -- acting ------------------------------------------------------------------------------------

    def _buttons(self, outcome: Outcome) -> None:
        with ui.element("div").classes("buttons"):
            replay = ui.button("Replay", icon="replay", on_click=self._replay).props("no-caps")
            replay.set_enabled(outcome.injection is not None)
            ui.button("Fly again without fault", icon="flight_takeoff", on_click=self._fly_golden).props(
                "no-caps outline"
            )
            download = ui.button("Download MCAP", icon="download", on_click=self._download)
            download.props("no-caps outline")
            viewer = ui.button("Open in a viewer", icon="open_in_new", on_click=self._viewer)
            viewer.props("no-caps outline")
            kept = recordings(self._service, self._campaign, self._stored.id).flight.is_file()
            for one in (download, viewer):
                one.set_enabled(kept)

    @told
    async def _replay(self) -> None:
        with self._waiting("flown again, to be compared"):
            answer = await ask(replay_run, self._service, self._campaign, self._stored.id)
        with self._answer, ui.element("div").classes("panel").props('role="status"'):
            ui.label(f"Replay: {answer.answer.replace('_', ' ')}").classes("state-title")
            for line in answer.differences or [
                "The same record, the same outcome, every message to the bit."
            ]:
                ui.label(line)

    @told
    async def _fly_golden(self) -> None:
        spec = self._stored.spec.model_copy(update={"fault": None})
        flight = await ask(create_flight, self._service, NewFlight(mission=spec), Response())
        ui.navigate.to(address(flight.campaign.campaign))

    @told
    async def _record(self) -> None:
        with self._waiting("flown again, to be recorded"):
            await ask(record_run, self._service, self._campaign, self._stored.id)
        ui.navigate.reload()

    def _download(self) -> None:
        ui.download.from_url(self._url)

    def _viewer(self) -> None:
        path = recordings(self._service, self._campaign, self._stored.id).flight
        with ui.dialog() as dialog, ui.card():
            ui.label("Open in a viewer").classes("heading")
            ui.label(
                "On this machine this starts the viewer that is installed (Rerun, Foxglove, PlotJuggler):"
            )
            ui.label(f"zenfi view {path}").classes("log")
            ui.label("On another, download the recording and open it there.")
            with ui.row().classes("actions"):
                ui.button("Download MCAP", on_click=self._download).props("no-caps flat")
                ui.button("Close", on_click=dialog.close).props("no-caps flat autofocus")
        dialog.open()

    @property
    def _url(self) -> str:
        return f"/api/v1/campaigns/{quote(self._campaign.label, safe='')}/runs/{self._stored.id}/recording"

    @contextmanager
    def _waiting(self, what: str) -> Iterator[None]:
        self._answer.clear()
        with self._answer, ui.row().classes("buttons").props('role="status"') as waiting:
            # Nothing that moves: a browser would paint it with the processor that flies.
            ui.label(f"The run is {what}. This page goes on by itself.")
        try:
            yield
        finally:
            waiting.delete()

    # -- showing -----------------------------------------------------------------------------------

    async def _flight(self, outcome: Outcome, others: list[RelatedRun]) -> None:
        kept = await ask(self._kept, outcome)
        needed = kept.complete if outcome.golden is not None else kept.flight.is_file()
        if not needed:
            self._offer(outcome, recorded=kept.flight.is_file())
            return
        try:
            beside = await ask(self._beside, others)
            flights = await ask(read_flights, outcome, kept, beside)
        except REFUSED as error:
            trouble(str(error), "Record the run again to put another file in its place.")
            ui.button("Record", icon="fiber_manual_record", on_click=self._record).props("no-caps").classes(
                "submit"
            )
            return
        flight_views(outcome, flights)

    def _beside(self, others: list[RelatedRun]) -> list[tuple[Outcome, Path]]:
        """What became of the same flight in other arms that were recorded."""
        files = {one.id: recordings(self._service, self._campaign, one.id).flight for one in others}
        return [
            (outcome, path)
            for run, path in files.items()
            if path.is_file()
            and (outcome := read_run(self._service, self._campaign, run).outcome) is not None
        ]

    def _kept(self, outcome: Outcome) -> Recordings:
        """The recordings; of a golden twin that was not recorded, those of a run that flew the same."""
        kept = recordings(self._service, self._campaign, self._stored.id)
        if outcome.golden is None or kept.twin.is_file():
            return kept
        same = same_flights(self._service.store, self._campaign, outcome.golden.digest)
        files = (recordings(self._service, self._campaign, run).flight for run in same)
        return kept._replace(twin=next((path for path in files if path.is_file()), kept.twin))

    def _offer(self, outcome: Outcome, *, recorded: bool) -> None:
        with section("Flight"):
            if outcome.spec.clock == "realtime":
                nothing(
                    "There is no recording of this run.", "It was flown in real time: it does not repeat."
                )
                return
            what = "its golden twin" if recorded else "this run"
            nothing(
                f"There is no recording of {what}.",
                "Record it: it is flown again, which gives the same flight to the bit.",
            )
            ui.button("Record", icon="fiber_manual_record", on_click=self._record).props("no-caps").classes(
                "submit"
            )

    async def _logs(self) -> None:
        folder = self._service.store.artefacts(self._campaign)
        with section("Logs", "The ends of what the process and the workers of this campaign wrote."):
            tails = await ask(lambda: [(path.name, _tail(path)) for path in sorted(folder.glob("*.log"))])
            written = [(name, text) for name, text in tails if text]
            for name, text in written:
                ui.label(name).classes("note")
                log(text, name)
            if not written:
                ui.label("Nobody complained.").classes("note")


def _tail(path: Path) -> str:
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - LOG_BYTES, 0))
        return file.read().decode(errors="replace").strip()


def _detector(stored: StoredRun) -> str:
    asked = stored.spec.detector
    return (
        ""
        if asked is None
        else f"{asked.scheme}, recomputes: {asked.recovery.replace('_', ' and ')}, gate {asked.gate}"
    )


def _quality(outcome: Outcome) -> None:
    """Quality of flight beside the golden twin's."""
    golden = outcome.golden
    mine = {"result": outcome.result, **_measures(outcome.qof)}
    twins = {"result": golden.result, **_measures(golden.qof)} if golden is not None else {}
    heads = ("", "this run", "its golden twin") if golden is not None else ("", "this run")
    rows = [[name, text, twins.get(name, "")][: len(heads)] for name, text in mine.items()]
    with section("Quality of flight", outcome.reason):
        table("Quality of flight", heads, rows, heads[1:])


def _harm(outcome: Outcome) -> None:
    """What harmed the flight beside its golden twin, and what its properties say."""
    if outcome.harm is None and not outcome.properties:
        return
    with section("Harm"):
        if outcome.harm is not None:
            events = [
                f"{event.kind.replace('_', ' ')} at {event.at_ns / 1e9:.2f} s" for event in outcome.harm
            ]
            ui.label("Harmed: " + ", ".join(events) if events else "Not harmed.").classes("state-title")
        if outcome.properties:
            rows = [
                (
                    one.property,
                    "holds" if one.holds else "violated",
                    f"{one.robustness:+.3g}",
                    f"{one.at_ns / 1e9:.2f}",
                )
                for one in outcome.properties
            ]
            heads = ("property", "verdict", "margin", "decided at (s)")
            table("Properties", heads, rows, heads[2:])


def _measures(qof: QoF) -> dict[str, str]:
    told = {
        "flight time (s)": f"{qof.flight_time_s:.2f}",
        "distance (m)": f"{qof.distance_m:.2f}",
        "energy (kJ)": f"{qof.energy_kj:.3f}",
        "replans": str(qof.replans),
        "smallest distance to an obstacle (m)": f"{qof.min_clearance_m:.2f}",
        "missions per charge": f"{qof.missions_per_charge:.1f}",
    }
    if qof.coverage is not None:
        told["covered (%)"] = f"{100 * qof.coverage:.1f}"
    return told


def _nodes(outcome: Outcome) -> None:
    rows = [
        (
            name,
            report.result,
            str(report.restarts),
            ", ".join(report.causes),
            str(report.steps),
            str(report.dropped),
            str(report.malformed + report.outdated),
            str(report.alarms),
            str(report.recomputed),
        )
        for name, report in outcome.nodes.items()
    ]
    heads = ("node", "result", "restarts", "ended by", "steps", "dropped", "refused", "alarms", "recomputed")
    table("Nodes", heads, rows, ("restarts", *heads[4:]))
    if outcome.detection is not None and outcome.detection.alarms:
        ui.label("Alarms").classes("heading")
        alarms = [
            (
                f"{one.virtual_time_ns / 1e9:.3f}",
                one.stage,
                one.state or "made no sense",
                f"{one.score:.3g}",
                one.action.replace("_", " "),
                "true" if one.true else "false",
            )
            for one in outcome.detection.alarms
        ]
        columns = ("time (s)", "stage", "state", "score", "what was done", "after the fault")
        table("Alarms", columns, alarms, ("time (s)", "score"))
