"""Everything that is handed in for a claim: one document, of which pages and tables are written."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from importlib.metadata import version

import numpy as np

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.statistics.proportions import median_interval
from dashboard.campaigns.store.listing import stored_run
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from dashboard.evidence.budget import UpsetBudget
from dashboard.evidence.counts import ElementStrikes, Flown, InjectedRun, strikes_of
from dashboard.evidence.coverage import DiagnosticCoverage, coverages
from dashboard.evidence.ledger import LedgerLine, reckon
from dashboard.evidence.scope import ASSUMPTIONS, NEVER_STRUCK, UnstruckPart
from services.models.base import Strict
from services.models.oracles.harm import HarmKind, kinds

DOMINANT = 10
"""Faults that are listed one by one."""


class LineEvidence(Strict):
    """An element's line of the ledger. ``*_low`` and ``*_high`` are the ends of intervals of 95 %.

    ``not_injected``, ``failed`` and ``not_judged`` are runs of its cells that say nothing of it.
    """

    element: str
    struck: int
    manifested: int
    manifests_low: float
    manifests_high: float
    harmed: int
    harms_low: float
    harms_high: float
    not_injected: int
    failed: int
    not_judged: int
    rate_per_hour: float
    bound_per_hour: float


class Margin(Strict):
    """Time from the strike to the harm, in seconds of virtual time, over an element's harmful faults."""

    element: str
    faults: int
    shortest_s: float
    median_s: float
    median_low_s: float | None
    median_high_s: float | None


class HarmfulStrike(Strict):
    """A strike that harmed, and its part of the rate. ``replay`` is the command that flies it again."""

    element: str
    rate_per_hour: float
    struck: str
    site: str
    seed: int
    harm: list[HarmKind]
    margin_s: float
    digest: str
    replay: str


class CampaignEvidence(Strict):
    """A campaign that the evidence stands on; ``spec_sha256`` is that of its specification as JSON.

    ``replays`` counts the answers when runs were flown again (``zenfi replay LABEL``).
    """

    label: str
    spec_sha256: str
    runs: int
    flown: int
    proven: int
    failed: int
    replays: dict[str, int]


class Evidence(Strict):
    """A claim and what carries it. Rates are failures per flight hour.

    ``more_strikes``: without further harm, how many more are needed; 0 if the target is met, None without
    a target or if no number is enough. ``assumptions`` are the budget's and the method's.
    """

    name: str
    zenfi: str
    confidence: float
    target_per_hour: float | None
    rate_per_hour: float
    bound_per_hour: float
    more_strikes: int | None
    budget: UpsetBudget
    lines: list[LineEvidence]
    margins: list[Margin]
    dominant: list[HarmfulStrike]
    coverage: list[DiagnosticCoverage]
    campaigns: list[CampaignEvidence]
    assumptions: list[str]
    never_struck: list[UnstruckPart]

    @property
    def meets_target(self) -> bool | None:
        """Whether the bound is within the target; None without one."""
        return None if self.target_per_hour is None else self.bound_per_hour <= self.target_per_hour


def gather(store: Store, campaigns: Sequence[CampaignEntry], budget: UpsetBudget) -> Evidence:
    """All that the campaigns in a store say of a budget.

    :raises BadSpecError: if an element names no cell of theirs, or several.
    """
    flown: list[Flown] = [(one, list(store.records(one))) for one in campaigns]
    elements = [strikes_of(element, flown) for element in budget.elements]
    ledger = reckon(budget, [one.counts for one in elements])
    faults = [
        _fault(store, one, strike, line.rate_per_hour / len(one.harmful))
        for one, line in zip(elements, ledger.lines, strict=True)
        for strike in one.harmful
    ]
    return Evidence(
        name=budget.name,
        zenfi=version("zenfi"),
        confidence=budget.confidence,
        target_per_hour=budget.target_per_hour,
        rate_per_hour=ledger.rate_per_hour,
        bound_per_hour=ledger.bound_per_hour,
        more_strikes=ledger.more_strikes,
        budget=budget,
        lines=[_line(*one) for one in zip(elements, ledger.lines, strict=True)],
        margins=[_margin(one.element.name, faults) for one in elements if one.harmful],
        dominant=sorted(faults, key=lambda one: (-one.rate_per_hour, one.margin_s))[:DOMINANT],
        coverage=coverages(store, flown, budget.confidence),
        campaigns=[_campaign(store, *one) for one in flown],
        assumptions=[*budget.assumptions, *ASSUMPTIONS],
        never_struck=list(NEVER_STRUCK),
    )


def _line(strikes: ElementStrikes, line: LedgerLine) -> LineEvidence:
    return LineEvidence(
        element=line.element.name,
        struck=line.counts.struck,
        manifested=line.counts.manifested,
        manifests_low=line.manifests.low,
        manifests_high=line.manifests.high,
        harmed=line.counts.harmed,
        harms_low=line.harms.low,
        harms_high=line.harms.high,
        not_injected=strikes.not_injected,
        failed=strikes.failed,
        not_judged=strikes.not_judged,
        rate_per_hour=line.rate_per_hour,
        bound_per_hour=line.bound_per_hour,
    )


def _margin(element: str, faults: Sequence[HarmfulStrike]) -> Margin:
    seconds = [one.margin_s for one in faults if one.element == element]
    low, high = median_interval(np.array(seconds)) or (None, None)
    return Margin(
        element=element,
        faults=len(seconds),
        shortest_s=min(seconds),
        median_s=float(np.median(seconds)),
        median_low_s=low,
        median_high_s=high,
    )


def _fault(store: Store, of: ElementStrikes, strike: InjectedRun, rate_per_hour: float) -> HarmfulStrike:
    stored = stored_run(store, strike.campaign, strike.run.id)
    assert stored is not None  # noqa: S101 - its result was read from the same store
    assert stored.outcome is not None  # noqa: S101
    record, fault = stored.outcome.injection, stored.outcome.spec.fault
    assert record is not None  # noqa: S101 - it was injected
    assert fault is not None  # noqa: S101
    where = record.symbol or record.module
    site = f"{where} {record.instruction} {record.register_name}" if where else " ".join(record.state)
    bits = ",".join(map(str, record.bits))
    harmed_s = strike.result.harmed_at_s or 0.0
    return HarmfulStrike(
        element=of.element.name,
        rate_per_hour=rate_per_hour,
        struck=fault.target,
        site=f"{site.strip()} bit {bits}" if bits else site.strip(),
        seed=strike.run.seed,
        harm=kinds(stored.outcome.harm or ()),
        margin_s=harmed_s - record.virtual_time_ns / 1e9,
        digest=stored.outcome.digest,
        replay=f"zenfi replay {strike.campaign.label}/{strike.run.id}",
    )


def _campaign(store: Store, campaign: CampaignEntry, runs: Sequence[FlightRecord]) -> CampaignEvidence:
    phases = Counter(one.phase for one in runs)
    results = [one.result for one in runs if one.result is not None]
    proven = sum(bool(one.proof) for one in results)
    spec = campaign.spec.model_dump_json(exclude_unset=True)
    return CampaignEvidence(
        label=campaign.label,
        spec_sha256=hashlib.sha256(spec.encode()).hexdigest(),
        runs=len(runs),
        flown=len(results) - proven,
        proven=proven,
        failed=phases["failed"],
        replays=store.replay_counts(campaign),
    )
