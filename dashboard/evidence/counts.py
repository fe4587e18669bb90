"""What a campaign's store knows of each element of a budget: its strikes, what they changed and harmed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.spec import Cell
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.evidence.budget import Element
from dashboard.evidence.ledger import StrikeCounts
from deploy.errors import BadSpecError

Flown = tuple[CampaignEntry, Sequence[FlightRecord]]
"""A campaign and its runs."""


class InjectedRun(NamedTuple):
    """A run whose fault was there when read back, and its result."""

    campaign: CampaignEntry
    run: FlightRecord
    result: Result

    @property
    def manifested(self) -> bool:
        """Whether any message differs from the golden twin's, or the flight ended otherwise."""
        twin = (self.result.twin_result, self.result.twin_digest)
        return (self.result.result, self.result.digest) != twin


@dataclass(frozen=True, slots=True)
class ElementStrikes:
    """The runs that stand for an element: its ``strikes``, and those that say nothing of it.

    ``not_injected`` struck nothing, ``failed`` did not fly, of ``not_judged`` harm is not known.
    """

    element: Element
    strikes: Sequence[InjectedRun]
    not_injected: int
    failed: int
    not_judged: int

    @property
    def harmful(self) -> list[InjectedRun]:
        """The strikes that harmed a mission, in the order of campaigns and runs."""
        return [one for one in self.strikes if one.result.harm]

    @property
    def counts(self) -> StrikeCounts:
        """How many strikes there were, and what came of them. Harm without a sign is a sign, too."""
        manifested = sum(one.manifested or bool(one.result.harm) for one in self.strikes)
        return StrikeCounts(len(self.strikes), manifested, len(self.harmful))


def strikes_of(element: Element, campaigns: Sequence[Flown]) -> ElementStrikes:
    """The runs of the cells that an element names.

    :raises BadSpecError: if it names none, or cells of several arms or faults: these are different questions.
    """
    found = list(runs_of(element, campaigns))
    cells = {(campaign.label, run.cell.arm, run.cell.fault) for campaign, run in found}
    wanted = (
        f"element {element.name!r} (arm={element.arm!r}, world={element.world!r}, fault={element.fault!r})"
    )
    if not found:
        every = sorted({str(run.cell) for _, runs in campaigns for run in runs})
        message = f"{wanted}: no such cell; there are {', '.join(every)}"
        raise BadSpecError(message)
    if len(cells) > 1:
        several = ", ".join("/".join(filter(None, one)) for one in sorted(cells))
        message = f"{wanted}: name one of {several}"
        raise BadSpecError(message)
    strikes, not_injected, failed, not_judged = [], 0, 0, 0
    for campaign, run in found:
        if run.result is None:
            failed += run.phase == "failed"
        elif run.result.injection != "injected":
            not_injected += 1
        elif run.result.harm is None:
            not_judged += 1
        else:
            strikes.append(InjectedRun(campaign, run, run.result))
    return ElementStrikes(element, strikes, not_injected, failed, not_judged)


def runs_of(element: Element, campaigns: Sequence[Flown]) -> Iterator[tuple[CampaignEntry, FlightRecord]]:
    """The runs of the cells that an element names, with their campaign, in the order of planning."""
    named = Cell(element.arm, element.world, element.fault)
    for campaign, runs in campaigns:
        if element.campaign not in ("", campaign.label):
            continue
        for run in runs:
            if all(want in ("", have) for want, have in zip(named, run.cell, strict=True)):
                yield campaign, run
