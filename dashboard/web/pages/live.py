"""Flights that are under way: where they are, what they see, what they are told; faults by hand."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Annotated, Any
from urllib.parse import quote

import numpy as np
from fastapi import Query
from nicegui import ui

from dashboard.api.problems import NotFoundError
from dashboard.api.processes.campaign_runner import is_flight
from dashboard.api.routes.runs import read_run
from dashboard.api.service import Service
from dashboard.campaigns.state_machine import OPEN
from dashboard.campaigns.store.listing import LARGEST_ID, RunQuery, StoredRun, line, run_page, stored_run
from dashboard.campaigns.store.queries import CampaignEntry, UnknownCampaignError
from dashboard.web.charts.curves import Chart, Curve
from dashboard.web.charts.flight_style import GOLDEN, INJECTED, RECOMPUTED, STRUCK
from dashboard.web.charts.pictures import depth_picture, map_picture
from dashboard.web.charts.plan_view import PlanView, moving_obstacles, path, vehicle
from dashboard.web.charts.scene_view import SceneView
from dashboard.web.components.flight_forms import fault_form, flight_form
from dashboard.web.components.frame import REFUSED, absent, ask, frame, nothing, plain, section, trouble
from dashboard.web.components.parts import Readings, legend
from deploy.recording.flight_status import FlightStatus
from deploy.recording.snapshot import FlightSnapshot
from services.models.mission import MissionSpec
from sim.world import World, make_world

LOOK_S = 0.25
"""Between two looks at the chosen flight; it is told as often."""

LIST_S = 1.0

LIVE = ("Live flights", "/live")

_COMMANDS = (("vx", GOLDEN), ("vy", INJECTED), ("vz", RECOMPUTED), ("yaw rate", STRUCK))


_Why = tuple[Any, ...]
"""What draws why there is no flight to be seen, and what it is given."""


@dataclass
class Track:
    """What was seen of one flight, or of its golden twin."""

    twin: bool
    presents: list[FlightStatus] = field(default_factory=list)

    def take(self, present: FlightStatus) -> bool:
        """Take in how it stands; whether that is news."""
        if self.presents and present.time_s <= self.presents[-1].time_s:
            return False
        self.presents.append(present)
        return True

    @property
    def points(self) -> list[tuple[float, float, float]]:
        """Where it was, (x, y, z) in the world frame, m."""
        return [one.position_m for one in self.presents]

    def commands(self) -> list[Curve]:
        """The flight commands received so far."""
        told = [one for one in self.presents if one.command is not None]
        times = np.array([one.time_s for one in told])
        values = np.array([one.command for one in told], dtype=np.float64).reshape(-1, 4)
        return [Curve(name, colour, times, values[:, at]) for at, (name, colour) in enumerate(_COMMANDS)]


def register(service: Service) -> None:
    """Declare the page of flights under way."""

    @ui.page("/live", response_timeout=60)
    async def page(flight: str = "", run: Annotated[int, Query(ge=0, le=LARGEST_ID)] = 0) -> None:
        with frame("Live flights"):
            chosen = ui.column().classes("section")
            watched = ui.column().classes("section")
            with chosen:
                live = _Live(service, watched, flight, run)
            with (
                ui.element("div").classes("panel"),
                section("Fly one mission", "It waits for no campaign."),
            ):
                flight_form(service, lambda label: ui.navigate.to(address(label)))
            await live.look()
            ui.timer(LIST_S, live.look, immediate=False)


def address(label: str, run: int = 0) -> str:
    """The address of the page of a flight."""
    return f"/live?flight={quote(label, safe='')}" + (f"&run={run}" if run else "")


def under_way(service: Service) -> dict[int, tuple[str, FlightStatus]]:
    """Label and present of every run that flies now."""
    campaign: dict[int, tuple[str, FlightStatus]] = {}
    for event in service.event_bus.newest():
        if event.kind == "flight":
            told = json.loads(event.data)
            campaign[told["run"]] = (told["campaign"], FlightStatus.model_validate(told["present"]))
    return campaign


class _Live:
    """The flight that the page shows, a choice among those under way, and why there is none.

    A run that the address names stays. Else the page shows what flies (of the campaign that the address
    names), and after its end the flight that began last: of it most is still to come.
    """

    def __init__(self, service: Service, place: ui.column, label: str, run: int) -> None:
        self._service, self._place, self._label, self._pinned = service, place, label, run
        self._flying: dict[int, str] = {}
        self._shown = 0
        self._told: _Why | None = None
        self._places: _Places | None = None
        self._choice = ui.select({}, label="Flights under way", on_change=lambda told: self._go(told.value))
        self._choice.classes("choice").props("outlined dense")
        self._state = ui.column().classes("section")

    async def look(self) -> None:
        """Show the flights that are under way now."""
        flying = under_way(self._service)
        self._flying = {number: told for number, (told, _) in sorted(flying.items())}
        run = self._next()
        if run and run != self._shown:
            await self._show(run)
        elif not self._shown:
            await self._tell()
        names = {number: f"{told}, run {number}" for number, told in self._flying.items()}
        value = self._shown if self._shown in names else None
        if (names, value) != (self._choice.options, self._choice.value):
            self._choice.set_options(names, value=value)

    def _next(self) -> int:
        """The run to be shown; 0 if there is none."""
        if self._pinned or self._shown in self._flying:
            wanted = self._pinned or self._shown
            return wanted if wanted in self._flying else 0
        return max((run for run, told in self._flying.items() if self._label in ("", told)), default=0)

    def _go(self, value: int | None) -> None:
        if value is not None and value in self._flying and value != self._shown:
            ui.navigate.to(address(self._flying[value], value))

    async def _show(self, run: int) -> None:
        campaign = await ask(self._service.store.find, self._flying[run])
        stored = await ask(read_run, self._service, campaign, run)
        world = await ask(make_world, stored.spec.world, stored.spec.seed)
        self._shown = run
        self._state.clear()
        if self._places is None:
            with self._place:
                self._places = _Places()
        _Watched(self._service, self._places, campaign, run, stored.spec, world)

    async def _tell(self) -> None:
        """Say why there is nothing to be seen; again only when that has changed, as it holds links."""
        why = await self._why()
        if why != self._told:
            self._told = why
            self._state.clear()
            with self._state:
                why[0](*why[1:])

    async def _why(self) -> _Why:
        if not self._label:
            remedy = "Fly one below, or start a campaign on the page Campaigns."
            return nothing, "No flight is under way.", remedy
        try:
            return await ask(_standing, self._service, self._label, self._pinned)
        except UnknownCampaignError as error:
            return absent, plain(error), "Choose another flight, or fly one below.", LIVE
        except NotFoundError as error:
            return absent, str(error), "The campaign's page has all its runs.", _campaign(self._label)
        except REFUSED as error:
            return trouble, str(error), "This page tries again by itself."


def _standing(service: Service, label: str, run: int) -> _Why:
    """How a campaign, or a run of it, stands that does not fly at this moment.

    :raises UnknownCampaignError: if there is none of that label.
    :raises NotFoundError: if it has no such run.
    """
    campaign = service.store.find(label)
    single = is_flight(campaign.spec)
    if single and not run:
        run = run_page(service.store, campaign, RunQuery(limit=1)).runs[0].id
    stored = read_run(service, campaign, run) if run else None
    if stored is not None and stored.phase not in OPEN:
        return _over, label, run, _ended_as(stored)
    phase = line(service.store, campaign).phase
    if phase in ("queued", "running"):
        what = f"Run {run} of {label}" if run and not single else label
        return nothing, f"{what} is about to fly.", "It is shown here as soon as it does."
    if phase in ("done", "cancelled"):
        return nothing, f"{label} has ended: {phase}.", "Its page has the details.", _campaign(label)
    return nothing, f"{label} does not fly: it is {phase}.", "Resume it on its page.", _campaign(label)


def _ended_as(stored: StoredRun) -> str:
    return stored.result.result if stored.result is not None else stored.error or stored.phase


def _over(label: str, run: int, result: str) -> None:
    """A run has ended: how, and where one goes from here."""
    nothing(f"Run {run} of {label} has ended: {result}.", "Its page has the details.")
    with ui.row().classes("links"):
        ui.link("Open the flight", f"/campaigns/{quote(label, safe='')}/runs/{run}")
        ui.link(*LIVE)


def _campaign(label: str) -> tuple[str, str]:
    return "Open the campaign", f"/campaigns/{quote(label, safe='')}"


class _Places:
    """Where parts of the page stand. The scene is every flight's; the other places are filled anew."""

    def __init__(self) -> None:
        self.head = ui.column().classes("section")
        with ui.element("div").classes("panels"):
            with ui.element("div").classes("panel"):
                self.scene = SceneView("The flight in three dimensions")
            self.panels = ui.element("div").classes("among")
        self.fault = ui.column().classes("panel")


class _Watched:
    """One flight as it goes on, in the place of the one before."""

    def __init__(
        self,
        service: Service,
        places: _Places,
        campaign: CampaignEntry,
        run: int,
        spec: MissionSpec,
        world: World,
    ) -> None:
        self._service, self._campaign, self._run, self._world = service, campaign, run, world
        self._tracks = {True: Track(True), False: Track(False)}
        self._sight: FlightSnapshot | None = None
        injected = spec.fault is not None
        self._colours = {True: GOLDEN, False: INJECTED if injected else GOLDEN}
        self._scene, self._fault = places.scene, places.fault
        for place in (places.head, places.panels, places.fault):
            place.clear()
        with places.head:
            with section(f"{campaign.label}, run {run}", f"{spec.mission} in {world.name}, seed {spec.seed}"):
                self._state = ui.label("under way").classes("note").props('role="status"')
                self._after = ui.column().classes("section")
            self._readings = Readings(
                ["time", "distance", "energy", "speed", "replans", "smallest clearance"]
            )
            legend({"golden": GOLDEN, "with the fault": INJECTED} if injected else {"flight": GOLDEN})
            self._timer = ui.timer(LOOK_S, self._look)
        self._scene.draw_world(world)
        with places.panels:
            self._draw_panels()
        with self._fault, section("Inject a fault by hand", _BY_HAND):
            fault_form(service, campaign, lambda label: ui.navigate.to(address(label)))
        self._fault.set_visibility(not injected and spec.clock == "lockstep" and campaign.spec.runs == 1)

    def _draw_panels(self) -> None:
        with ui.element("div").classes("panel"):
            self._plan = PlanView(self._world, "Plan view with the map that the flight has made")
            legend({"seen free": "#56b4e9", "seen occupied": "#d55e00"})
        with ui.element("div").classes("panel"):
            ui.label("Depth image").classes("heading")
            self._depth = ui.image().classes("depth")
            self._depth.props('no-spinner no-transition alt="Depth image"')
            ui.label("Near is bright; the darkest is 20 m away or farther.").classes("note")
        with ui.element("div").classes("panel"):
            ui.label("Flight commands").classes("heading")
            self._chart = Chart("m/s, rad/s", Track(False).commands())

    async def _look(self) -> None:
        told = under_way(self._service).get(self._run)
        if told is None:
            await self._ended()
            return
        present = told[1]
        if self._tracks[present.twin].take(present):
            self._draw(present)
        sight = self._service.runner.sight(self._run)
        if sight is not None and sight != self._sight:
            self._sight = sight
            await self._see(sight)

    def _draw(self, present: FlightStatus) -> None:
        track, colour = self._tracks[present.twin], self._colours[present.twin]
        name = "twin" if present.twin else "flight"
        self._state.set_text("its golden twin flies first" if present.twin else "under way")
        self._readings.show(readings(present))
        self._scene.draw_path(name, track.points, colour)
        self._scene.move("vehicle", present.position_m, colour)
        paths = [path(one.points, self._colours[one.twin]) for one in self._tracks.values()]
        self._plan.draw("paths", *paths)
        self._scene.move_obstacles(present.time_s)
        moving = moving_obstacles(self._world, present.time_s)
        self._plan.draw("now", *moving, vehicle(present.position_m, colour))
        self._chart.show(track.commands())

    async def _see(self, sight: FlightSnapshot) -> None:
        if sight.depth is not None:
            self._depth.set_source(await ask(depth_picture, sight.depth))
        if sight.map is not None:
            self._plan.draw_map(await ask(map_picture, sight.map, self._world))

    async def _ended(self) -> None:
        stored = await ask(stored_run, self._service.store, self._campaign, self._run)
        if stored is None or stored.phase in OPEN or self._after.is_deleted:
            return
        self._timer.deactivate()
        self._state.set_visibility(False)
        self._fault.set_visibility(False)
        with self._after:
            _over(self._campaign.label, self._run, _ended_as(stored))


_BY_HAND = (
    "It is injected after this moment. In virtual time a flight follows from its specification: so another "
    "flight is flown from the beginning, the same to the bit until then, and this one is its golden twin."
)


def readings(present: FlightStatus) -> dict[str, str]:
    """How a flight stands, in words."""
    told = {"time": f"{present.time_s:.1f} s", "speed": f"{np.linalg.norm(present.velocity_m_s):.1f} m/s"}
    if present.qof is not None:
        told |= {
            "distance": f"{present.qof.distance_m:.1f} m",
            "energy": f"{present.qof.energy_kj:.2f} kJ",
            "replans": str(present.qof.replans),
            "smallest clearance": f"{present.qof.min_clearance_m:.2f} m",
        }
    return told
