"""The tables of pilots and guards: how a mission is flown, and what keeps a wrong number from harming it.

A guard is a part of the stack that refuses, limits or repairs. Each has a switch (``guards`` of a mission),
so that what it is worth can be measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, get_args

from pydantic import Field

from services.bus.message_checks import AddedChecks
from services.models.base import Strict
from services.models.plug_ins import MessageGuard
from services.system import plug_ins

GuardName = Literal[
    "finite",
    "range",
    "order",
    "strayed",
    "recheck",
    "squeeze",
    "brake",
    "dense",
    "limits",
    "clip",
    "restart",
]

Guards = frozenset[str]
"""Those that are switched on: names of guards of ours, and of those that other packages add."""


class Guard(NamedTuple):
    """Where a guard works, what it does, and what it costs a flight without a fault."""

    stages: tuple[str, ...]
    does: str
    costs: str


_ALL_STAGES = ("perception", "planning", "control")

GUARDS: Mapping[GuardName, Guard] = MappingProxyType(
    {
        "finite": Guard(
            _ALL_STAGES,
            "refuses messages with numbers that are not finite; control counts such an error as zero",
            "a look at each number",
        ),
        "range": Guard(
            _ALL_STAGES,
            "refuses a pose, goal, lens or map that no vehicle of this kind can have",
            "a look at each number",
        ),
        "order": Guard(
            _ALL_STAGES,
            "refuses a trajectory whose time runs backwards, or that is older than the one last checked",
            "a look at each number",
        ),
        "strayed": Guard(
            ("planning",), "plans anew where the vehicle is farther than 2.5 m off its trajectory", "nothing"
        ),
        "recheck": Guard(
            ("planning",),
            "plans anew whenever the newest trajectory is found to collide, counted as new or not",
            "a plan now and then",
        ),
        "squeeze": Guard(
            ("planning",), "tries a way with less clearance before it retreats", "a narrower passage"
        ),
        "brake": Guard(
            ("control",),
            "stops 2 s before a collision that any verdict finds; without it, one that is counted as new",
            "nothing",
        ),
        "dense": Guard(
            ("planning", "control"),
            "points every 0.25 s, flown by the clock along a smooth curve; "
            "without it every 0.5 s, each held for as long as it lasts",
            "twice the points",
        ),
        "limits": Guard(
            ("control",),
            "limits the position error, the velocity error and the integral that control believes",
            "a slower return from far off",
        ),
        "clip": Guard(("control",), "limits the flight command to 3 m/s and 90 deg/s", "nothing"),
        "restart": Guard(_ALL_STAGES, "starts a node again that has died", "nothing"),
    }
)
"""In the order of the flow of data. ``clip`` and ``restart`` are what the published system has."""

ALL_GUARDS: Guards = frozenset(get_args(GuardName))


class Pilot(NamedTuple):
    """How a pilot flies: see ``docs/pilots.md`` for what is published of each part, and where.

    ``leads_on``: plans from a state ahead in flight where there is time, otherwise always from a standstill.
    Gains: 1/s, 1/s^2 and of the velocity error; level and vertical apart where they differ.
    """

    about: str
    guards: Guards
    leads_on: bool
    proportional_level: float
    proportional_vertical: float
    integral: float
    derivative: float


PILOTS: Mapping[str, Pilot] = MappingProxyType(
    {
        "guarded": Pilot(
            "ours: plans in flight, follows the curve by a PID, with every guard",
            ALL_GUARDS,
            leads_on=True,
            proportional_level=1.2,
            proportional_vertical=1.2,
            integral=0.1,
            derivative=0.15,
        ),
        "baseline": Pilot(
            "the published one: plans from a standstill, flies waypoint after waypoint, trusts its messages",
            frozenset(("clip", "restart")),
            leads_on=False,
            proportional_level=0.2,
            proportional_vertical=0.5,
            integral=0.0,
            derivative=0.0,
        ),
    }
)


def find_pilot(name: str) -> Pilot:
    """The pilot of that name: one of the table, else one that another package adds.

    :raises UnknownPlugInError: if there is none.
    """
    return plug_ins.find("pilots", name, PILOTS)


def find_guard(name: str) -> Guard | MessageGuard:
    """The guard of that name: one of the table, else one that another package adds.

    :raises UnknownPlugInError: if there is none.
    """
    own: Mapping[str, Guard | MessageGuard] = {str(one): guard for one, guard in GUARDS.items()}
    return plug_ins.find("guards", name, own)


def numbered(active: Guards) -> tuple[str, ...]:
    """The guards in the order in which a node counts what they do: ours, then those ``active`` besides."""
    return (*GUARDS, *sorted(active - ALL_GUARDS))


def added_guards(active: Guards, stage: str) -> AddedChecks:
    """What the guards that other packages add check of a stage's messages, in the order of their names.

    :raises UnknownPlugInError: if one is not installed.
    """
    found = {name: find_guard(name) for name in sorted(active - ALL_GUARDS)}
    return {
        name: guard.refuses
        for name, guard in found.items()
        if isinstance(guard, MessageGuard) and stage in guard.stages
    }


class Pace(Strict):
    """What the baseline takes its time for. Assumed, to reach the published pace (``docs/pilots.md``)."""

    take_off_s: float = Field(default=10.0, ge=0, le=120, description="hover before it looks round")
    look_round_s: float = Field(default=8.0, ge=0, le=120, description="one turn on the spot before it plans")
    plan_wait_s: float = Field(default=6.0, ge=0, le=120, description="standstill before each plan")
