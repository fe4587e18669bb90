"""Whether designs that were flown harmed as often as was predicted of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from dashboard.campaigns.spec import CampaignSpec, arm_conditions, load_campaign
from dashboard.campaigns.statistics.proportions import clopper_pearson
from dashboard.design.document import DesignLine, DesignStudy, read_design_study
from dashboard.design.prediction import PlannedStrikes, predict
from dashboard.evidence.counts import Flown, strikes_of
from dashboard.evidence.ledger import StrikeCounts
from deploy.errors import BadSpecError
from services.models.base import Strict

TOGETHER = 0.95
"""The level with which the predictions of all designs of one check hold together."""


class CheckedDesign(Strict):
    """A design that was flown: of ``strikes`` so many ``harmed``; the part, with its 95 % interval (exact).

    ``predicted`` and its interval are made for these very strikes. ``inside``: the flown part lies in it.
    ``in_flown_interval``: the predicted part lies in the interval of what was flown.
    """

    design: str
    campaign: str
    strikes: int
    harmed: int
    flown: float
    flown_low: float
    flown_high: float
    predicted: float
    predicted_low: float
    predicted_high: float
    level: float
    inside: bool
    in_flown_interval: bool


def check_designs(folder: Path, campaigns: Sequence[Flown]) -> list[CheckedDesign]:
    """Hold campaigns that fly designs of a folder against what was predicted of them.

    Of n designs each has an interval of 1 - 0.05 / n, so that all hold together in 95 % (Bonferroni).

    :raises BadSpecError: if a campaign flies no design of the folder, flies it otherwise, or has no strikes.
    """
    document = read_design_study(folder)
    flown = [(design, one) for one in campaigns for design in _flown_designs(folder, document, one)]
    level = 1 - (1 - TOGETHER) / max(len(flown), 1)
    return [_checked(folder, document, design, one, level) for design, one in flown]


def _flown_designs(folder: Path, document: DesignStudy, flown: Flown) -> list[DesignLine]:
    campaign, _ = flown
    arms = [one.name for one in campaign.spec.arms]
    found = [one for one in document.lines.values() if one.name in arms and one.campaign]
    if not found:
        names = ", ".join(one.name for one in document.lines.values() if one.campaign)
        message = f"{campaign.label}: none of its arms ({', '.join(arms)}) is a design of {folder}: {names}"
        raise BadSpecError(message)
    return found


def _checked(
    folder: Path, document: DesignStudy, design: DesignLine, flown: Flown, level: float
) -> CheckedDesign:
    campaign, _ = flown
    planned = load_campaign(str(folder / str(design.campaign)))
    for what in _other_parts(design, planned, campaign.spec):
        place = folder / str(design.campaign)
        message = f"{campaign.label}: arm {design.name!r} flies {what} otherwise than {place}"
        raise BadSpecError(message)
    strikes, harmed = [], 0
    for one, element in zip(design.elements, document.budget.elements, strict=True):
        if not one.masked:
            cell = {"campaign": campaign.label, "arm": design.name, "fault": one.fault}
            made = strikes_of(element.model_copy(update=cell), [flown]).counts
            strikes.append(PlannedStrikes(StrikeCounts(one.struck, one.struck, one.harmed), made.struck))
            harmed += made.harmed
    predicted = predict(strikes, level)
    if predicted.strikes == 0:
        message = f"{campaign.label}: arm {design.name!r} has no strike yet; fly the campaign first"
        raise BadSpecError(message)
    part = harmed / predicted.strikes
    ends = clopper_pearson(harmed, predicted.strikes)
    return CheckedDesign(
        design=design.name,
        campaign=campaign.label,
        strikes=predicted.strikes,
        harmed=harmed,
        flown=part,
        flown_low=ends.low,
        flown_high=ends.high,
        predicted=predicted.share,
        predicted_low=predicted.low,
        predicted_high=predicted.high,
        level=level,
        inside=predicted.low <= part <= predicted.high,
        in_flown_interval=ends.low <= predicted.share <= ends.high,
    )


def _other_parts(design: DesignLine, planned: CampaignSpec, flown: CampaignSpec) -> Iterator[str]:
    """What a campaign flies of a design in another way than its file says; later seeds are as good."""
    if (planned.worlds or (planned.mission.world,)) != (flown.worlds or (flown.mission.world,)):
        yield "its worlds"
    if flown.mission.seed < planned.mission.seed:  # those may be the flights that the prediction is made of
        yield "its seeds"
    ours, theirs = (
        {
            condition.name: (mission.model_dump(exclude={"seed"}), condition.fault)
            for arm, condition, mission in arm_conditions(spec)
            if arm == design.name
        }
        for spec in (planned, flown)
    )
    for name, (mission, fault) in ours.items():
        if name not in theirs:
            yield f"fault {name!r}"
            continue
        other_mission, other = theirs[name]
        if mission != other_mission:
            yield "the mission"
        if fault is None or other is None or fault.model_copy(update={"seed": other.seed}) != other:
            yield f"fault {name!r}"
