"""Flights that are under way: where they are, what they see, what they are told; faults by hand."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from urllib.parse import quote

import numpy as np
from nicegui import ui

from dashboard.api.flights import Flight, read_flight
from dashboard.api.service import Service
from dashboard.campaigns.listing import stored_run
from dashboard.campaigns.store import Campaign
from dashboard.web.curves import Chart, Curve
from dashboard.web.flight_forms import fault_form, flight_form
from dashboard.web.flight_style import GOLDEN, INJECTED, RECOVERED, STRUCK
from dashboard.web.frame import REFUSED, ask, frame, nothing, plain, section, trouble
from dashboard.web.parts import Readings, legend
from dashboard.web.pictures import depth_picture, map_picture
from dashboard.web.plan_view import PlanView, path, vehicle
from dashboard.web.scene_view import SceneView
from deploy.present import Present
from deploy.sight import Sight
from services.bus.mission import MissionSpec
from sim.world import World, make_world

LOOK_S = 0.25
"""Between two looks at the chosen flight; it is told as often."""

LIST_S = 1.0

_COMMANDS = (("vx", GOLDEN), ("vy", INJECTED), ("vz", RECOVERED), ("yaw rate", STRUCK))


@dataclass
class Track:
    """What was seen of one flight, or of its golden twin."""

    twin: bool
    presents: list[Present] = field(default_factory=list)

    def take(self, present: Present) -> bool:
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
        """The flight commands so far."""
        told = [one for one in self.presents if one.command is not None]
        times = np.array([one.time_s for one in told])
        values = np.array([one.command for one in told], dtype=np.float64).reshape(-1, 4)
        return [Curve(name, colour, times, values[:, at]) for at, (name, colour) in enumerate(_COMMANDS)]


def register(here: Service) -> None:
    """Declare the page."""

    @ui.page("/live", response_timeout=60)
    async def page(flight: str = "", run: int = 0) -> None:
        with frame("Live flights"):
            chosen = ui.column().classes("section")
            watched = ui.column().classes("section")
            with (
                ui.element("div").classes("panel"),
                section("Fly one mission", "It waits for no campaign."),
            ):
                flight_form(here, lambda label: ui.navigate.to(address(label)))
            await _watch(here, chosen, watched, flight, run)


def address(label: str, run: int = 0) -> str:
    """Where a flight is watched."""
    return f"/live?flight={quote(label, safe='')}" + (f"&run={run}" if run else "")


def under_way(here: Service) -> dict[int, tuple[str, Present]]:
    """Label and present of every run that flies now."""
    found: dict[int, tuple[str, Present]] = {}
    for event in here.hub.newest():
        if event.kind == "flight":
            told = json.loads(event.data)
            found[told["run"]] = (told["campaign"], Present.model_validate(told["present"]))
    return found


async def _watch(here: Service, chosen: ui.column, watched: ui.column, label: str, run: int) -> None:
    """Offer what flies, and show the flight of that label, or the first that there is."""
    with chosen:
        choice = ui.select({}, label="Flights under way", on_change=lambda told: go(told.value))
        choice.classes("choice").props("outlined dense")
        state = ui.column().classes("section")

    def go(value: int | None) -> None:
        if value is not None and value in here_now and value != run:
            ui.navigate.to(address(here_now[value], value))

    here_now: dict[int, str] = {}
    shown: list[int] = []

    async def look() -> None:
        nonlocal run
        flying = under_way(here)
        here_now.clear()
        here_now.update({number: told for number, (told, _) in sorted(flying.items())})
        names = {number: f"{told}, run {number}" for number, told in here_now.items()}
        if names != choice.options:
            choice.set_options(names, value=run if run in names else None)
        if not shown:
            run = run or _first(here_now, label)
            if run in here_now and await _show(here, watched, here_now[run], run):
                shown.append(run)
                state.clear()
                choice.set_value(run)
                return
        if not shown:
            await _tell(here, state, label)

    await look()
    ui.timer(LIST_S, look, immediate=False)


def _first(flying: dict[int, str], label: str) -> int:
    wanted = (number for number, told in flying.items() if label in ("", told))
    return next(wanted, 0)


async def _tell(here: Service, state: ui.column, label: str) -> None:
    """Why there is nothing to be seen."""
    state.clear()
    with state:
        if not label:
            nothing("No flight is under way.", "Fly one below, or start a campaign on the page Campaigns.")
            return
        try:
            flight: Flight = await ask(lambda: read_flight(here, here.store.find(label)))
        except REFUSED as error:
            trouble(plain(error), "Choose another flight, or fly one below.")
            return
        if flight.campaign.phase in ("queued", "running"):
            nothing(f"{label} is about to fly.", "It is shown here as soon as it does.")
        else:
            nothing(f"{label} has ended: {flight.campaign.phase}.", "All about it stands on its page.")
            ui.link("Open the flight", f"/campaigns/{quote(label, safe='')}/runs/{flight.run.id}")


async def _show(here: Service, place: ui.column, label: str, run: int) -> bool:
    found = await ask(here.store.find, label)
    stored = await ask(stored_run, here.store, found, run)
    if stored is None:
        return False
    world = await ask(make_world, stored.spec.world, stored.spec.seed)
    with place:
        _Watched(here, found, run, stored.spec, world)
    return True


class _Watched:
    """One flight as it goes on."""

    def __init__(self, here: Service, found: Campaign, run: int, spec: MissionSpec, world: World) -> None:
        self._here, self._found, self._run, self._world = here, found, run, world
        self._tracks = {True: Track(True), False: Track(False)}
        self._sight: Sight | None = None
        struck = spec.fault is not None
        self._colours = {True: GOLDEN, False: INJECTED if struck else GOLDEN}
        with section(f"{found.label}, run {run}", f"{spec.mission} in {world.name}, seed {spec.seed}"):
            self._state = ui.label("under way").classes("note").props('role="status"')
            self._after = ui.row()
            self._readings = Readings(
                ["time", "distance", "energy", "speed", "replans", "smallest clearance"]
            )
            legend({"golden": GOLDEN, "with the fault": INJECTED} if struck else {"flight": GOLDEN})
            with ui.element("div").classes("panels"):
                with ui.element("div").classes("panel"):
                    self._scene = SceneView(world, "The flight in three dimensions")
                with ui.element("div").classes("panel"):
                    self._plan = PlanView(world, "Plan view with the map that the flight has made")
                    legend({"seen free": "#56b4e9", "seen occupied": "#d55e00"})
                with ui.element("div").classes("panel"):
                    ui.label("Depth image").classes("heading")
                    self._depth = ui.image().classes("depth")
                    self._depth.props('no-spinner no-transition alt="Depth image"')
                    ui.label("Near is bright; the darkest is 20 m away or farther.").classes("note")
                with ui.element("div").classes("panel"):
                    ui.label("Flight commands").classes("heading")
                    self._chart = Chart("m/s, rad/s", Track(False).commands())
            self._fault = ui.column().classes("panel")
            with self._fault, section("Inject a fault by hand", _BY_HAND):
                fault_form(here, found, lambda label: ui.navigate.to(address(label)))
        self._fault.set_visibility(not struck and spec.clock == "lockstep" and found.spec.runs == 1)
        self._timer = ui.timer(LOOK_S, self._look)

    async def _look(self) -> None:
        told = under_way(self._here).get(self._run)
        if told is None:
            await self._ended()
            return
        present = told[1]
        if self._tracks[present.twin].take(present):
            self._draw(present)
        sight = self._here.conductor.sight(self._run)
        if sight is not None and sight != self._sight:
            self._sight = sight
            await self._see(sight)

    def _draw(self, present: Present) -> None:
        track, colour = self._tracks[present.twin], self._colours[present.twin]
        name = "twin" if present.twin else "flight"
        self._state.set_text("its golden twin flies first" if present.twin else "under way")
        self._readings.show(readings(present))
        self._scene.draw_path(name, track.points, colour)
        self._scene.move("vehicle", present.position_m, colour)
        paths = [path(one.points, self._colours[one.twin]) for one in self._tracks.values()]
        self._plan.draw("paths", *paths)
        self._plan.draw("now", vehicle(present.position_m, colour))
        self._chart.show(track.commands())

    async def _see(self, sight: Sight) -> None:
        if sight.depth is not None:
            self._depth.set_source(await ask(depth_picture, sight.depth))
        if sight.map is not None:
            self._plan.draw_map(await ask(map_picture, sight.map, self._world))

    async def _ended(self) -> None:
        stored = await ask(stored_run, self._here.store, self._found, self._run)
        if stored is None or stored.phase in ("queued", "leased", "running"):
            return
        self._timer.deactivate()
        result = stored.result.result if stored.result is not None else stored.error or stored.phase
        self._state.set_text(f"it has ended: {result}")
        self._fault.set_visibility(False)
        with self._after:
            ui.link("Open the flight", f"/campaigns/{quote(self._found.label, safe='')}/runs/{self._run}")


_BY_HAND = (
    "It strikes after this moment. In virtual time a flight follows from its specification: so another "
    "flight is flown from the beginning, the same to the bit until then, and this one is its golden twin."
)


def readings(present: Present) -> dict[str, str]:
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
