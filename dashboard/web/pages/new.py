"""A new campaign: a preset or a form, and what it would take and could tell before anything is flown."""

from __future__ import annotations

import os
from typing import Any

from fastapi import Response
from nicegui import ui
from pydantic import ValidationError

from dashboard.analysis.tables import forecast as in_words
from dashboard.api.routes.campaigns import NewCampaign, admitted, create
from dashboard.api.service import Service
from dashboard.campaigns.forecast import Forecast, forecast
from dashboard.campaigns.presets import presets
from dashboard.campaigns.spec import CampaignSpec, RecordingPolicy
from dashboard.web.components.frame import REFUSED, ask, frame, section, told
from deploy.errors import one_line
from detector.schemes.registry import with_models
from services.kernels import GOAL_KERNELS, KERNELS, PLANNERS
from services.models.inter_kernel_states import GROUPS, STATES
from services.system import plug_ins
from sim.world import world_names

OWN = "own"
KERNEL_TARGETS = [name for name in KERNELS if name not in GOAL_KERNELS.values()]
STATE_TARGETS = [*GROUPS, *STATES]
FIELDS = ["any", "sign", "exponent", "mantissa"]
MASKS = ["bits", "uniform", "byte", "word"]
NONE = "none"
KEPT = {
    NONE: "none; a run can be recorded later",
    "failures": "of missions that failed",
    "all": "of all flights",
}


def register(service: Service) -> None:
    """Declare the page that creates a campaign."""

    @ui.page("/new", response_timeout=30)
    async def page(preset: str = "demo") -> None:
        with frame("New campaign"):
            known = {one.name: f"{one.name}: {one.about}" for one in presets()}
            _Form(service, known, preset if preset in known else OWN)


class _Form:
    def __init__(self, service: Service, known: dict[str, str], chosen: str) -> None:
        self._service = service
        self._asked = 0
        look = told(self._look)
        with section("What to fly"):
            self._kind = ui.select(
                {OWN: "of my own", **known}, value=chosen, label="campaign", on_change=look
            )
            self._kind.props("outlined").classes("wide")
        with ui.row().classes("form") as self._of_preset:
            self._scale = ui.number(
                "scale: times its flights", value=1.0, min=0.001, max=1000, on_change=look
            )
            self._scale.props("outlined")
        with ui.row().classes("form") as self._of_own:
            self._own(look)
        with ui.row().classes("form"):
            self._keep = ui.select(KEPT, value="none", label="recordings to look through", on_change=look)
            self._keep.props("outlined")
        with section("What it takes"):
            self._told = ui.label().classes("forecast").props('role="status"')
            self._wrong = ui.label().classes("wrong").props('role="alert"')
            self._start = ui.button("Start", icon="flight_takeoff", on_click=told(self._create)).props(
                "no-caps"
            )
            ui.timer(0, look, once=True)

    def _own(self, look: Any) -> None:
        def number(label: str, value: float, least: float, most: float | None = None) -> ui.number:
            made = ui.number(label, value=value, min=least, max=most, precision=0, on_change=look)
            return made.props("outlined")

        def choice(label: str, options: list[str], value: Any) -> ui.select:
            several = isinstance(value, list)
            made = ui.select(options, label=label, value=value, multiple=several, on_change=look)
            return made.props("outlined")

        self._name = ui.input("name", value="mine", on_change=look).props("outlined")
        self._runs = number("flights per arm and world", 20, 1)
        self._seed = number("first seed", 0, 0)
        self._worlds = choice("worlds", world_names(), ["sparse"])
        self._kernels = choice("kernels to inject", KERNEL_TARGETS, ["octomap", "rrt_star"])
        self._states = choice("states to inject", STATE_TARGETS, [])
        self._bits = number("bits", 1, 1, 64)
        self._field = choice("bits of", FIELDS, "any")
        self._mask = choice("mask", MASKS, "bits")
        self._planner = choice("planner", [*PLANNERS, *plug_ins.names("planners")], "rrt_star")
        self._time = number("mission ends after, s", 200, 1)
        self._detector = choice("detector that recomputes", [NONE, *with_models()], NONE)

    def _wanted(self) -> CampaignSpec:
        """The specification from the form, checked.

        :raises BadSpecError: if it cannot be flown.
        """
        if self._kind.value != OWN:
            asked = NewCampaign(preset=self._kind.value, scale=self._scale.value or 0)
        else:
            asked = NewCampaign(spec=self._own_spec())
        wanted = asked.made().model_copy(update={"recording": RecordingPolicy(keep=self._keep.value)})
        return admitted(self._service, wanted)

    def _own_spec(self) -> CampaignSpec:
        fault = {
            "bits": int(self._bits.value or 0),
            "field": self._field.value,
            "mask": self._mask.value,
        }
        kernels = [
            {
                "name": name,
                "fault": {"target": name, **fault},
                "mission": {"planner": name} if name in PLANNERS else {},
            }
            for name in self._kernels.value
        ]
        states = [{"name": n, "fault": {"level": "source", "target": n, **fault}} for n in self._states.value]
        mission = {
            "seed": int(self._seed.value or 0),
            "planner": self._planner.value,
            "limits": {"mission_time_s": self._time.value or 0},
            "detector": None if self._detector.value == NONE else {"scheme": self._detector.value},
        }
        return CampaignSpec.model_validate(
            {
                "name": self._name.value,
                "runs": int(self._runs.value or 0),
                "mission": mission,
                "arms": [{"name": "golden"}, *kernels, *states],
                "worlds": self._worlds.value,
            }
        )

    async def _look(self) -> None:
        """Say what the campaign would take; of several asked at once, the last."""
        self._asked += 1
        this = self._asked
        own = self._kind.value == OWN
        self._of_own.set_visibility(own)
        self._of_preset.set_visibility(not own)
        said, wrong = "", ""
        try:
            said = await ask(self._forecast, await ask(self._wanted))
        except ValidationError as error:
            wrong = one_line(error)
        except REFUSED as error:
            wrong = str(error)
        if this == self._asked:
            self._told.set_text(said)
            self._wrong.set_text(wrong)
            self._start.set_enabled(not wrong)

    def _forecast(self, spec: CampaignSpec) -> str:
        plan: Forecast = forecast(spec, self._service.store, len(os.sched_getaffinity(0)))
        return in_words(spec.name, plan)

    async def _create(self) -> None:
        wanted = await ask(self._wanted)
        made = await ask(create, self._service, wanted, None, Response())
        ui.navigate.to(f"/campaigns/{made.label}")
