"""Which arms of campaigns are protections of one vehicle, and of which elements' faults they were flown."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from dashboard.campaigns.spec import arm_conditions
from dashboard.evidence.budget import Element, UpsetBudget
from dashboard.evidence.counts import Flown, runs_of, strikes_of
from deploy.errors import BadSpecError
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.pilots import find_pilot

NOTHING, SCHEMES = "nothing", ("DMR", "TMR")
"""The names of the options that no arm flies: none, and a second or a second and third computer."""

PROTECTIVE = ("pilot", "guards", "detector")
"""The fields of a mission that protect it."""

_PLACE = {"world", "seed"}


class FlownCell(NamedTuple):
    """The cell of a campaign in all its worlds: label, arm and fault."""

    campaign: str
    arm: str
    fault: str

    def __str__(self) -> str:
        return " / ".join(filter(None, self))


class ProtectedElement(NamedTuple):
    """An element of the budget, the fault that stands for its upsets, and the cell that flew it bare."""

    element: Element
    fault: FaultSpec
    bare: FlownCell


@dataclass(frozen=True, slots=True)
class Protection:
    """Something that a mission can have switched on: its mission, and its cell of each element's fault.

    ``arms`` are all that fly it, by campaign.
    """

    name: str
    mission: MissionSpec
    cells: Mapping[str, FlownCell]
    arms: frozenset[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class FlownArms:
    """One vehicle: its bare mission and arms, the elements, its protections, and arms that are none of it."""

    mission: MissionSpec
    arms: frozenset[tuple[str, str]]
    elements: tuple[ProtectedElement, ...]
    protections: tuple[Protection, ...]
    left_out: tuple[str, ...]


class _Flown(NamedTuple):
    cell: FlownCell
    mission: MissionSpec
    fault: FaultSpec | None


def flown_arms(budget: UpsetBudget, campaigns: Sequence[Flown]) -> FlownArms:
    """The bare arm that the elements of a budget name, and the arms that protect it.

    :raises BadSpecError: if an element names no cell or no bare one, if elements fly different missions, or a
        protection has no bare arm beside it or did not fly an element's fault.
    """
    flown = [
        _Flown(FlownCell(campaign.label, arm, condition.name), mission, condition.fault)
        for campaign, _ in campaigns
        for arm, condition, mission in arm_conditions(campaign.spec)
    ]
    by_cell = {one.cell: one for one in flown}
    elements = tuple(_element(element, campaigns, by_cell) for element in budget.elements)
    mission = _one_mission(elements, by_cell)
    bare, others, left_out = set[tuple[str, str]](), list[_Flown](), list[str]()
    for one in flown:
        if _base(one.mission) != _base(mission):
            _refuse_without_partner(one, mission, flown)
            left_out.append(f"{one.cell.campaign} / {one.cell.arm}: {_differences(one.mission, mission)}")
        elif missing := sorted(mission.active_guards - one.mission.active_guards):
            left_out.append(f"{one.cell.campaign} / {one.cell.arm}: without {', '.join(missing)}")
        elif _protection(one.mission) == _protection(mission):
            bare.add(one.cell[:2])
        else:
            others.append(one)
    protections = tuple(_named(others, elements))
    return FlownArms(mission, frozenset(bare), elements, protections, tuple(dict.fromkeys(left_out)))


def combined(mission: MissionSpec, chosen: Collection[MissionSpec]) -> dict[str, Any] | None:
    """The changes of a bare ``mission`` that switch on all that the ``chosen`` ones have.

    None if they cannot be on together: two detectors, or two pilots.
    """
    pilots = {one.pilot for one in chosen} - {mission.pilot}
    detectors = {_text(one.detector): one.detector for one in chosen if one.detector is not None}
    if len(pilots) > 1 or len(detectors) > 1:
        return None
    changes: dict[str, Any] = {"pilot": next(iter(pilots))} if pilots else {}
    guards = mission.active_guards.union(*(one.active_guards for one in chosen))
    unchanged = find_pilot(*pilots).guards if pilots and mission.guards is None else mission.active_guards
    if guards != unchanged:
        changes["guards"] = sorted(guards)
    for detector in detectors.values():
        changes["detector"] = detector.model_dump(mode="json", exclude_defaults=True)
    return changes


def _element(
    element: Element, campaigns: Sequence[Flown], cells: Mapping[FlownCell, _Flown]
) -> ProtectedElement:
    strikes_of(element, campaigns)  # refuses an element without a cell, or with several
    campaign, run = next(runs_of(element, campaigns))
    cell = FlownCell(campaign.label, run.cell.arm, run.cell.fault)
    found = cells[cell]
    if found.fault is None:
        message = f"element {element.name!r}: {cell} flies without a fault; name a cell with one"
        raise BadSpecError(message)
    if found.mission.detector is not None:
        message = f"element {element.name!r}: arm {cell.arm!r} has a detector; name the arm without one"
        raise BadSpecError(message)
    return ProtectedElement(element, found.fault, cell)


def _one_mission(elements: Sequence[ProtectedElement], cells: Mapping[FlownCell, _Flown]) -> MissionSpec:
    first, *others = (cells[one.bare].mission for one in elements)
    for element, other in zip(elements[1:], others, strict=True):
        if other.model_dump(exclude=_PLACE) != first.model_dump(exclude=_PLACE):
            message = (
                f"element {element.element.name!r}: {element.bare} flies another mission than "
                f"{elements[0].bare}: {_differences(other, first)}; a design is of one vehicle"
            )
            raise BadSpecError(message)
    return first


def _refuse_without_partner(one: _Flown, mission: MissionSpec, flown: Sequence[_Flown]) -> None:
    protected = one.mission.detector is not None or one.mission.guards is not None
    beside = any(
        other.cell[:2] != one.cell[:2]
        and other.cell.campaign == one.cell.campaign
        and other.mission.detector is None
        and _base(other.mission) == _base(one.mission)
        for other in flown
    )
    if protected and not beside:
        message = (
            f"{one.cell.campaign}: arm {one.cell.arm!r} has no bare arm beside it, which flies the same "
            f"without its protection: {_differences(one.mission, mission)}"
        )
        raise BadSpecError(message)


def _named(others: Sequence[_Flown], elements: Sequence[ProtectedElement]) -> Iterator[Protection]:
    """Each protection once, by the name of the first arm that flies it."""
    groups: dict[str, list[_Flown]] = {}
    for one in others:
        groups.setdefault(_protection(one.mission), []).append(one)
    taken = {NOTHING, *SCHEMES}
    for group in groups.values():
        first = group[0].cell
        name = first.arm if first.arm not in taken else f"{first.campaign}/{first.arm}"
        taken.add(name)
        cells = {one.element.name: _cell_of(name, one, group) for one in elements}
        yield Protection(name, group[0].mission, cells, frozenset(one.cell[:2] for one in group))


def _cell_of(name: str, element: ProtectedElement, group: Sequence[_Flown]) -> FlownCell:
    same = [one.cell for one in group if one.fault == element.fault]
    beside = [one for one in same if one.campaign == element.bare.campaign]
    if not same:
        message = (
            f"{group[0].cell.campaign}: arm {name!r} did not fly the fault of element "
            f"{element.element.name!r} ({element.bare}); fly it on the same seeds, or leave out one of both"
        )
        raise BadSpecError(message)
    return (beside or same)[0]


def _base(mission: MissionSpec) -> dict[str, Any]:
    """A mission without what protects it, where and on which seed it is flown."""
    return mission.model_dump(exclude={*PROTECTIVE, *_PLACE})


def _protection(mission: MissionSpec) -> str:
    return json.dumps([mission.pilot, sorted(mission.active_guards), _text(mission.detector)])


def _text(detector: Any) -> str:
    return "" if detector is None else str(detector.model_dump_json())


def _differences(one: MissionSpec, other: MissionSpec) -> str:
    ours, theirs = one.model_dump(exclude=_PLACE), other.model_dump(exclude=_PLACE)
    return "other " + ", ".join(name for name in ours if ours[name] != theirs[name])
