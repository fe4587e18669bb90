"""The boundary check of a mission: every name in a specification must be declared in its table."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import ValidationError

from deploy.platform import load_platform
from injector.architecture import AbsentError, require
from injector.preflight import check as preflight
from services.bus.mission import FaultSpec, MissionSpec
from services.bus.source_fault import eligible
from services.bus.states import GROUPS, STATES, members
from services.kernels import GOAL_KERNELS, KERNELS, PLANNERS
from sim.airframe import airframe
from sim.area import corners
from sim.world import make_world


class BadSpecError(ValueError):
    """A specification that cannot be flown: one line that names the field and the remedy."""


def check(spec: MissionSpec) -> None:
    """Refuse what cannot be flown, before anything is started.

    :raises BadSpecError: naming the field and what would be right.
    """
    _known("planner", spec.planner, PLANNERS)
    try:
        world = make_world(spec.world, spec.seed)
        if spec.mission != "navigation":
            corners(spec.area, world)
        airframe(spec.airframe)
        load_platform(spec.platform)
    except ValueError as error:
        raise BadSpecError(str(error)) from error
    if spec.fault is not None and spec.fault.level == "source":
        _check_source(spec.fault)
    elif spec.fault is not None:
        _check_instruction(spec.fault, spec)


def _check_source(fault: FaultSpec) -> None:
    _known("inter-kernel state", fault.target, [*STATES, *GROUPS])
    for state in members(fault.target):
        if not eligible(fault, state):
            kind = f"{state.width_bits}-bit {'floating-point' if state.floating else 'integer'} number"
            message = f"fault: {state.name} is a {kind}: it has no such bits"
            raise BadSpecError(message)


def _check_instruction(fault: FaultSpec, spec: MissionSpec) -> None:
    target = fault.target
    _known("kernel", target, KERNELS)
    if target in PLANNERS and target != spec.planner:
        message = f"kernel {target!r} never runs with planner {spec.planner!r}: choose --planner {target}"
        raise BadSpecError(message)
    if target in GOAL_KERNELS.values() and target != GOAL_KERNELS.get(spec.mission):
        message = f"kernel {target!r} never runs in mission {spec.mission!r}"
        raise BadSpecError(message)
    try:
        require(fault)
    except AbsentError as error:
        raise BadSpecError(str(error)) from error
    for finding in preflight():
        if not finding.ok:
            message = f"cannot inject: {finding.name}: {finding.remedy}"
            raise BadSpecError(message)


def _known(what: str, name: str, table: Iterable[str]) -> None:
    names = list(table)
    if name not in names:
        message = f"unknown {what} {name!r}; known: {', '.join(names)}"
        raise BadSpecError(message)


def one_line(error: ValidationError) -> str:
    """The first thing that is wrong, as ``field: what (value)``."""
    first = error.errors()[0]
    # Which form a field has and which kind of world it is goes without saying.
    where = ".".join(str(part) for part in first["loc"] if part != "definition") or "specification"
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    value = first.get("input")
    given = f", got {value!r}" if isinstance(value, (str, int, float)) else ""
    what = first["msg"].removeprefix("Value error, ")
    return f"{where}: {what}{given}{more}"
