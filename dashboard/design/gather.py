"""From stored campaigns and a budget to all designs: the harm they leave, their cost, what is predicted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version

import sqlalchemy as sa

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.spec import CampaignSpec
from dashboard.campaigns.statistics.proportions import clopper_pearson, newcombe_paired
from dashboard.campaigns.store.queries import CampaignEntry, outcome_fields
from dashboard.campaigns.store.schema import OutcomeRow, RunRow
from dashboard.campaigns.store.store import Store
from dashboard.design.designs import LIMIT, DesignChoice, DesignSpace, EvaluatedDesign, front
from dashboard.design.document import (
    CAMPAIGNS,
    DesignElement,
    DesignLine,
    DesignStudy,
    OptionLine,
    ProtectionLine,
)
from dashboard.design.overheads import RelativeOverhead, cost, golden_flights, mean_overhead
from dashboard.design.paired_strikes import PairedStrikes, paired_strikes
from dashboard.design.prediction import PlannedStrikes, predict
from dashboard.design.protections import NOTHING, SCHEMES, FlownArms, Protection, combined, flown_arms
from dashboard.design.second_computer import second_computers
from dashboard.design.specification import design_campaign, fault_name
from dashboard.evidence.budget import Element, UpsetBudget
from dashboard.evidence.counts import Flown, strikes_of
from dashboard.evidence.ledger import StrikeCounts
from deploy.errors import BadSpecError
from sim.vehicle.redundancy import RedundancyStudy

BARE = "design-00"
"""The name of the design with nothing on, whether or not it is on the front."""

AT_LEAST = 5
"""Designs that have a campaign: if fewer on the front can be flown, the next best have one, too."""

FLIGHTS = 100
"""Of each element in a design's campaign and world, if nothing else is asked for."""


@dataclass(frozen=True, slots=True)
class DesignRequest:
    """What is asked of a study: the budget, how many flights an element, and of further computers.

    The airframe of ``redundancy`` is the mission's, whatever is said here.
    """

    budget: UpsetBudget
    flights: int = FLIGHTS
    redundancy: RedundancyStudy = field(default_factory=RedundancyStudy)
    limit: int = LIMIT


def study_designs(
    store: Store, campaigns: Sequence[CampaignEntry], asked: DesignRequest
) -> tuple[DesignStudy, dict[str, CampaignSpec]]:
    """All designs of the vehicle that the campaigns flew, and by name the campaigns that fly the best.

    :raises BadSpecError: if the campaigns do not say what the budget asks for; the message says why.
    """
    flown: list[Flown] = [(one, list(store.records(one))) for one in campaigns]
    arms = flown_arms(asked.budget, flown)
    bare = golden_flights(_runs_of_arms(arms.arms, flown))
    costs = {
        one.name: cost(one.name, bare, golden_flights(_runs_of_arms(one.arms, flown)))
        for one in arms.protections
    }
    strikes = [paired_strikes(one, arms.protections, flown) for one in arms.elements]
    computers = second_computers(asked.redundancy.model_copy(update={"airframe": arms.mission.airframe}))
    space = DesignSpace(asked.budget, arms, strikes, costs, computers)
    listed = space.enumerate(asked.limit)
    designs = [space.evaluate(one) for one in listed.choices]
    writer = _DesignLines(asked, arms, space, flown)
    nothing = DesignChoice((NOTHING,) * len(strikes), (), "", (False,) * len(strikes))
    best = front(designs)
    lines = [writer.line(_name(place, one), one) for place, one in enumerate(best, 1)]
    more = _next_best(designs, best)
    others = [writer.line(_name(place, one), one) for place, one in enumerate(more, len(best) + 1)]
    found = DesignStudy(
        name=asked.budget.name,
        zenfi=version("zenfi"),
        campaigns=[one.label for one in campaigns],
        budget=asked.budget,
        options=[
            _option(element.element.name, name, known)
            for element, known, names in zip(arms.elements, strikes, space.options, strict=True)
            for name in names
        ],
        protections=[
            ProtectionLine(
                name=one.name,
                arms=[" / ".join(arm) for arm in sorted(one.arms)],
                changes=combined(arms.mission, [one.mission]) or {},
                cost=costs[one.name],
                check_share=_check_share(store, one, flown),
            )
            for one in arms.protections
        ],
        computers=list(computers.values()),
        left_out=list(arms.left_out),
        combinations=listed.combinations,
        impossible=listed.impossible,
        pruned=list(listed.pruned),
        designs=len(designs),
        bare=writer.line(BARE, space.evaluate(nothing)),
        front=lines,
        others=others,
        evaluated=[one.axes for one in designs],
    )
    flying = {one.name: writer.campaign(one) for one in found.lines.values() if one.campaign is not None}
    return found, flying


def _name(place: int, design: EvaluatedDesign) -> str:
    return BARE if design.choice.is_bare else f"design-{place:02d}"


def _next_best(
    designs: Sequence[EvaluatedDesign], best: Sequence[EvaluatedDesign]
) -> Sequence[EvaluatedDesign]:
    """As many designs as the front lacks to :data:`AT_LEAST` that can be flown, by their bounds."""
    kept = {one.choice for one in best}
    rest = [one for one in designs if one.choice not in kept and not all(one.choice.masked)]
    missing = AT_LEAST - sum(not all(one.choice.masked) for one in best)
    return sorted(rest, key=lambda one: (bool(one.choice.scheme), *one.axes))[: max(missing, 0)]


class _DesignLines:
    """Writes designs as lines of the document, and the campaigns that fly them."""

    def __init__(
        self, asked: DesignRequest, arms: FlownArms, space: DesignSpace, flown: Sequence[Flown]
    ) -> None:
        self._asked, self._arms, self._space = asked, arms, space
        self._sources = {campaign.label: campaign.spec for campaign, _ in flown}
        bare = [one.bare.campaign for one in arms.elements]
        self._worlds = _worlds({label: self._sources[label] for label in bare})
        self._struck = [_struck_part(one.element, flown) for one in arms.elements]

    def line(self, name: str, design: EvaluatedDesign) -> DesignLine:
        """The line of a design of that name."""
        elements = [self._element(number, design) for number in range(len(self._arms.elements))]
        open_ = [one for one in elements if not one.masked]
        known = [
            PlannedStrikes(StrikeCounts(one.struck, one.struck, one.harmed), one.planned) for one in open_
        ]
        target = self._asked.budget.target_per_hour
        return DesignLine(
            name=name,
            elements=elements,
            protections=list(design.choice.protections),
            scheme=design.choice.scheme,
            changes=self._space.changes(design.choice) or {},
            rate_per_hour=design.rate_per_hour,
            bound_per_hour=design.bound_per_hour,
            meets_target=None if target is None else design.bound_per_hour <= target,
            flight_time=design.flight_time,
            energy=design.energy,
            mass_kg=design.mass_kg,
            prediction=predict(known) if open_ else None,
            campaign=f"{CAMPAIGNS}/{name}.toml" if open_ else None,
        )

    def campaign(self, line: DesignLine) -> CampaignSpec:
        """The campaign that flies the design of a line."""
        faults = {
            one.fault: element
            for one, element in zip(line.elements, self._arms.elements, strict=True)
            if not one.masked
        }
        return design_campaign(
            line.name, self._arms.mission, line.changes, faults, self._sources, self._asked.flights
        )

    def _element(self, number: int, design: EvaluatedDesign) -> DesignElement:
        element, counts = self._arms.elements[number].element, design.counts[number]
        worlds = 1 if element.world else len(self._worlds)
        planned = round(self._asked.flights * worlds * self._struck[number])
        return DesignElement(
            element=element.name,
            option=design.choice.options[number],
            masked=counts is None,
            struck=counts.struck if counts is not None else 0,
            harmed=counts.harmed if counts is not None else 0,
            fault=fault_name(number, element.name),
            planned=planned if counts is not None else 0,
        )


def _worlds(sources: Mapping[str, CampaignSpec]) -> Sequence[object]:
    worlds = {label: one.worlds or (one.mission.world,) for label, one in sources.items()}
    (first, known), *others = worlds.items()
    for label, other in others:
        if other != known:
            message = f"{label}: flies other worlds than {first}; the elements' campaigns must fly the same"
            raise BadSpecError(message)
    return known


def _struck_part(element: Element, flown: Sequence[Flown]) -> float:
    found = strikes_of(element, flown)
    return len(found.strikes) / max(
        len(found.strikes) + found.not_injected + found.failed + found.not_judged, 1
    )


def _runs_of_arms(arms: frozenset[tuple[str, str]], flown: Sequence[Flown]) -> list[FlightRecord]:
    return [run for campaign, runs in flown for run in runs if (campaign.label, run.cell.arm) in arms]


def _option(element: str, name: str, strikes: PairedStrikes) -> OptionLine:
    masked = name in SCHEMES
    counts = StrikeCounts(0, 0, 0) if masked else strikes.counts(() if name == NOTHING else (name,))
    ends = clopper_pearson(counts.harmed, counts.struck) if not masked else None
    pairs = strikes.pairs(name) if not masked and name != NOTHING else None
    paired = sum(pairs) if pairs is not None else 0
    beside = newcombe_paired(pairs) if pairs is not None and paired else None
    difference = (pairs.first_only - pairs.second_only) / paired if pairs is not None and paired else None
    return OptionLine(
        element=element,
        option=name,
        masked=masked,
        struck=counts.struck,
        harmed=counts.harmed,
        residual=counts.harmed / counts.struck if counts.struck else float(not masked),
        low=ends.low if ends is not None else None,
        high=ends.high if ends is not None else None,
        difference=difference,
        difference_low=beside.low if beside is not None else None,
        difference_high=beside.high if beside is not None else None,
        unpaired=strikes.unpaired(name) if pairs is not None else 0,
    )


def _check_share(store: Store, protection: Protection, flown: Sequence[Flown]) -> RelativeOverhead | None:
    """The part of virtual time that checks take, over all flights with it; None without a detector."""
    if protection.mission.detector is None:
        return None
    shares = [
        share
        for campaign, _ in flown
        for label, arm in sorted(protection.arms)
        if label == campaign.label
        for share in _detection_shares(store, campaign, arm)
    ]
    return mean_overhead(shares) if shares else None


def _detection_shares(store: Store, campaign: CampaignEntry, arm: str) -> list[float]:
    query = (
        sa.select(outcome_fields(store.database)["detection", "detection_share"].as_float())
        .join(RunRow, RunRow.id == OutcomeRow.run_id)
        .where(RunRow.campaign_id == campaign.id, RunRow.arm == arm)
        .order_by(RunRow.id)
    )
    with store.reading() as connection:
        return [float(one) for one in connection.execute(query).scalars() if one is not None]
