"""The flight of a run as it was recorded: scene, plan and charts, with one moment for all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from nicegui import ui
from nicegui.events import GenericEventArguments

from dashboard.analysis.propagation import Picture, picture
from dashboard.analysis.recordings_reader import open_run
from dashboard.api.routes.recordings import Recordings
from dashboard.web.charts import run_data
from dashboard.web.charts.curves import Chart, Curve
from dashboard.web.charts.flight_style import STRUCK
from dashboard.web.charts.plan_view import PlanView, alarm, cross, moving_obstacles, path, vehicle
from dashboard.web.charts.run_data import COLOURS, FlownPath, Messages
from dashboard.web.charts.scene_view import SceneView
from dashboard.web.components.frame import section
from dashboard.web.components.parts import legend
from dashboard.web.components.propagation_view import propagation_view
from services.bus.topics import TICK_NS
from services.models.faults.specification import FaultSpec
from services.models.inter_kernel_states import STATES
from services.models.mission import MissionSpec
from services.models.outcome import Outcome
from sim.world import World, make_world

TICK_S = TICK_NS / 1e9
PLAY_S = 0.1
PLAYED = 5.0
"""So many times as fast as it flew."""


@dataclass(frozen=True, slots=True)
class Flights:
    """A run's flight, its golden twin's, and the ways of the same fault in other arms.

    Ways are by name: ``golden``, and what :func:`run_data.called` calls a flight.
    """

    world: World
    messages: Messages
    twin: Messages | None
    ways: Mapping[str, FlownPath]
    own: str
    propagated: Picture | None


def read_flights(outcome: Outcome, kept: Recordings, beside: Sequence[tuple[Outcome, Path]]) -> Flights:
    """Read the recordings, also of the flights ``beside``; takes a second or two.

    :raises BadSpecError: if one of them cannot be read.
    """
    run = open_run(kept.flight)
    golden = open_run(kept.twin) if outcome.golden is not None else None
    messages, twin = run.flight, golden.flight if golden is not None else None
    own = run_data.called(outcome)
    ways = {"golden": run_data.way(twin)} if twin is not None else {}
    for other, file in beside:
        name = run_data.called(other)
        if own != "flight" and _fault(other.spec) == _fault(run.spec) and name not in ways:
            ways[name] = run_data.way(open_run(file).flight)
    ways[own] = run_data.way(messages)
    return Flights(
        world=make_world(outcome.spec.world, outcome.spec.seed),
        messages=messages,
        twin=twin,
        ways=ways,
        own=own,
        propagated=picture(run, golden) if golden is not None else None,
    )


def _fault(spec: MissionSpec) -> FaultSpec | None:
    """What was asked for: when it was injected is known afterwards only."""
    return spec.fault.model_copy(update={"trigger": None}) if spec.fault is not None else None


def flight_views(outcome: Outcome, flights: Flights) -> None:
    """Draw all that was recorded of the flights."""
    views = _Views(outcome, flights)
    with section("Flight"):
        views.draw_places()
    with section("Inter-kernel states", "The dashed line is the golden twin's; upright lines are moments."):
        views.draw_charts()
    views.show(views.first_s)
    if flights.propagated is not None:
        with section("How the fault propagated", anchor="travelled"):
            propagation_view(flights.propagated)


class _Views:
    """Everything that shows the moment of the slider."""

    def __init__(self, outcome: Outcome, flights: Flights) -> None:
        self._outcome, self._flights = outcome, flights
        self._moments = run_data.moments(outcome)
        self._ways = flights.ways
        self._end_s = max((one.end_s for one in self._ways.values()), default=0.0)
        self._charts: list[Chart] = []
        self._playing = ui.timer(PLAY_S, self._advance, active=False)
        injections = [one.time_s for one in self._moments if one.colour == STRUCK]
        self.first_s = injections[0] if injections else 0.0

    # -- drawing -----------------------------------------------------------------------------------

    def draw_places(self) -> None:
        """Draw the time slider, the scene and the plan."""
        keys = {name: COLOURS[name] for name in self._ways}
        keys |= {one.name: one.colour for one in self._moments if one.name}
        legend(keys)
        with ui.element("div").classes("slide"):
            self._button = ui.button(icon="play_arrow", on_click=self._play)
            self._button.props('round dense aria-label="Play"')
            self._slider = ui.slider(min=0.0, max=self._end_s, step=TICK_S, value=self.first_s)
            self._slider.props('aria-label="Moment of the flight"')
            self._slider.on("update:model-value", self._slid, throttle=0.08)
        self._now = ui.label().classes("now mono").props('role="status"')
        with ui.element("div").classes("panels"):
            with ui.element("div").classes("panel"):
                around = np.concatenate([one.points for one in self._ways.values()])
                self._scene = SceneView("The flights in three dimensions")
                self._scene.draw_world(self._flights.world, around)
                for name, one in self._ways.items():
                    self._scene.draw_path(name, one.points.tolist(), COLOURS[name])
                ui.label("Drag to turn, wheel or two fingers to come nearer.").classes("note")
            with ui.element("div").classes("panel"):
                self._plan = PlanView(self._flights.world, "Plan view of the flights, north up", around)
                self._plan.draw("paths", *self._on_plan())
                ui.label("North is up; a square of the grid is 10 m wide.").classes("note")

    def _on_plan(self) -> list[str]:
        # The golden one last: its dashes lie on the others, and leave to be seen what lies below.
        drawn = [
            path(self._ways[name].points.tolist(), COLOURS[name], dashed=name == "golden")
            for name in sorted(self._ways, key=lambda name: name == "golden")
        ]
        flown = self._ways[self._flights.own]
        for one in self._moments:
            at = flown.at(one.time_s).tolist()
            drawn.append(cross(at, STRUCK) if one.colour == STRUCK else alarm(at))
        return drawn

    def draw_charts(self) -> None:
        """A chosen state, distance from the twin, speed, what is commanded."""
        first = run_data.first_choice(self._outcome)
        with ui.element("div").classes("panels"):
            with ui.element("div").classes("panel"):
                choice = ui.select(list(STATES), label="State", value=first, with_input=True)
                choice.props("outlined dense")
                chosen = ui.element("div")
                choice.on_value_change(lambda told: self._choose(chosen, str(told.value)))
                self._choose(chosen, first)
            if self._flights.twin is not None:
                times, metres = run_data.apart(self._ways[self._flights.own], self._ways["golden"])
                distance = Curve("distance", COLOURS[self._flights.own], times, metres)
                self._chart("distance to the golden twin (m)", [distance])
            speeds = [
                Curve(name, COLOURS[name], one.times_s, one.speeds_m_s, dashed=name == "golden")
                for name, one in self._ways.items()
            ]
            self._chart("speed (m/s)", speeds)
            for name in ("collision_check.time_to_collision", "command.vx", "command.vy", "command.yaw_rate"):
                if name != first:
                    self._chart(run_data.quantity(name), self._curves(name))

    def _curves(self, name: str) -> list[Curve]:
        return run_data.curves(self._flights.messages, self._flights.twin, name, self._flights.own)

    def _chart(self, quantity: str, curves: list[Curve]) -> None:
        with ui.element("div").classes("panel"):
            self._charts.append(Chart(quantity, curves, self._moments, end_s=self._end_s))

    def _choose(self, place: ui.element, name: str) -> None:
        """Draw another state in the first panel."""
        if name not in STATES:
            return
        place.clear()
        self._charts = [one for one in self._charts if not one.element.is_deleted]
        with place:
            chart = Chart(run_data.quantity(name), self._curves(name), self._moments, end_s=self._end_s)
            self._charts.append(chart)

    # -- moving ------------------------------------------------------------------------------------

    def _slid(self, told: GenericEventArguments) -> None:
        self.show(float(told.args))

    def _play(self) -> None:
        self._playing.active = not self._playing.active
        self._button.props(f"icon={'pause' if self._playing.active else 'play_arrow'}")
        if self._playing.active and self._slider.value >= self._end_s:
            self._slider.value = 0.0

    def _advance(self) -> None:
        time_s = min(self._slider.value + PLAY_S * PLAYED, self._end_s)
        self._slider.value = time_s
        self.show(time_s)
        if time_s >= self._end_s:
            self._play()

    def show(self, time_s: float) -> None:
        """Show this moment everywhere."""
        at = {name: one.at(time_s) for name, one in self._ways.items() if len(one.times_s)}
        for name, point in at.items():
            self._scene.move(name, point.tolist(), COLOURS[name])
        self._scene.move_obstacles(time_s)
        vehicles = [vehicle(point.tolist(), COLOURS[name]) for name, point in at.items()]
        self._plan.draw("now", *moving_obstacles(self._flights.world, time_s), *vehicles)
        for chart in self._charts:
            chart.point_at(time_s)
        places = [f"{name} at ({x:.2f}, {y:.2f}, {z:.2f}) m" for name, (x, y, z) in at.items()]
        if {"golden", self._flights.own} <= at.keys():
            metres = np.linalg.norm(at[self._flights.own] - at["golden"])
            places.append(f"{self._flights.own} is {metres:.3f} m from golden")
        self._now.set_text(f"{time_s:.2f} s, tick {round(time_s / TICK_S)}: {'; '.join(places)}")
