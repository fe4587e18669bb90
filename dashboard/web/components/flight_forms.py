"""Forms: one mission to be flown, one fault to be injected into a flight that is under way."""

from __future__ import annotations

from collections.abc import Callable

from fastapi import Response
from nicegui import ui

from dashboard.api.routes.flights import HandMadeFault, NewFlight, create_flight, inject_by_hand
from dashboard.api.service import Service
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.web.components.frame import ask, told
from services.kernels import GOAL_KERNELS, KERNELS, PLANNERS
from services.models.faults.specification import FaultSpec
from services.models.inter_kernel_states import GROUPS, STATES
from services.models.mission import MissionSpec
from services.models.oracles.properties import EXAMPLE
from services.models.pilots import PILOTS
from services.system import plug_ins
from sim.world import world_names

Made = Callable[[str], object]
"""Is told the label of the flight that was made."""

_MISSIONS = ("navigation", "scanning", "mapping", "search", "delivery")
_FIELDS = ("any", "sign", "exponent", "mantissa")
_MASKS = ("bits", "uniform", "byte", "word")
_RECURRENCES = ("once", "intermittent", "permanent", "rate")
_OFTEN = {"intermittent": "probability", "rate": "rate_hz"}
"""The field that says how often a fault of that recurrence strikes."""

_LARGEST_SEED = 2**32 - 1


def flight_form(service: Service, made: Made) -> None:
    """Ask for a mission and have it flown."""
    with ui.element("div").classes("fields"):
        mission = _choice("Mission", list(_MISSIONS), "scanning")
        world = _choice("World", world_names(), "sparse")
        planner = _choice("Planner", [*sorted(PLANNERS), *plug_ins.names("planners")], "rrt_star")
        pilot = _choice("Pilot", [*PILOTS, *plug_ins.names("pilots")], "guarded")
        seed = _number("Seed", 7, _LARGEST_SEED)
        judged = _text("Property to judge it by", f"such as: {EXAMPLE}")

    @told
    async def fly() -> None:
        spec = MissionSpec.model_validate(
            {
                "mission": mission.value,
                "world": world.value,
                "planner": planner.value,
                "pilot": pilot.value,
                "seed": _whole(seed),
                "properties": [judged.value] if judged.value else [],
            }
        )
        flight = await ask(create_flight, service, NewFlight(mission=spec), Response())
        made(flight.campaign.campaign)

    ui.button("Fly", icon="flight_takeoff", on_click=fly).classes("submit").props("no-caps")


def fault_form(service: Service, campaign: CampaignEntry, made: Made) -> None:
    """Ask for a fault and inject it into ``campaign`` now."""
    planner = campaign.spec.mission.planner
    idle = {name for name in PLANNERS if name != planner} | set(GOAL_KERNELS)
    struck = [*KERNELS, *([planner] if planner not in KERNELS else [])]
    kernels = {f"instruction {name}": f"kernel {name}" for name in struck if name not in idle}
    states = {f"source {name}": f"state {name}" for name in (*GROUPS, *STATES)}
    with ui.element("div").classes("fields"):
        target = ui.select({**kernels, **states}, label="Strikes", value="instruction pid", with_input=True)
        target.props("outlined dense")
        field = _choice("Bits of", list(_FIELDS), "any")
        bits = _number("Number of bits", 1, 8, least=1)
        mask = _choice("Mask", list(_MASKS), "bits")
        recurrence = _choice("Recurrence", list(_RECURRENCES), "once")
        how_often = ui.number("Probability, or upsets per second", min=0).props("outlined dense")
        opcodes = _text("Opcodes", "such as: vmulsd vaddsd")
        seed = _number("Seed", 0, _LARGEST_SEED)
        how_often.bind_visibility_from(recurrence, "value", lambda kind: kind in _OFTEN)
        opcodes.bind_visibility_from(recurrence, "value", lambda kind: kind != "once")

    @told
    async def inject() -> None:
        level, _, name = str(target.value).partition(" ")
        fault = FaultSpec.model_validate(
            {
                "level": level,
                "target": name,
                "field": field.value,
                "bits": _whole(bits),
                "mask": mask.value,
                "recurrence": recurrence.value,
                "seed": _whole(seed),
                **_recurring(str(recurrence.value), how_often.value, opcodes.value),
            }
        )
        flight = await ask(inject_by_hand, service, campaign, HandMadeFault(fault=fault), Response())
        made(flight.campaign.campaign)

    ui.button("Inject now", icon="bolt", on_click=inject, color="deep-orange-9").classes(
        "submit inject"
    ).props("no-caps")


def _recurring(recurrence: str, how_often: float | None, opcodes: str | None) -> dict[str, object]:
    """The fields that go with a recurrence; what is hidden in the form is not asked for."""
    fields: dict[str, object] = {}
    if recurrence in _OFTEN:
        fields[_OFTEN[recurrence]] = how_often
    if recurrence != "once" and opcodes:
        fields["opcodes"] = opcodes.split()
    return fields


def _text(label: str, hint: str) -> ui.input:
    return ui.input(label, placeholder=hint).props("outlined dense")


def _choice(label: str, options: list[str], value: str) -> ui.select:
    return ui.select(options, label=label, value=value).props("outlined dense")


def _number(label: str, value: int, most: int, least: int = 0) -> ui.number:
    return ui.number(label, value=value, min=least, max=most, precision=0).props("outlined dense")


def _whole(given: ui.number) -> int | None:
    """What was typed; None, which every specification refuses with the field's name, if nothing was."""
    return None if given.value is None else int(given.value)
