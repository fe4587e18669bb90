"""Diagnostic coverage: of the faults that harm without a detector, how many one catches before the harm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.spec import unprotected_arms
from dashboard.campaigns.statistics.proportions import lower_bound
from dashboard.campaigns.store.listing import stored_run
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from dashboard.evidence.counts import Flown
from services.models.base import Strict


class DiagnosticCoverage(Strict):
    """Of the ``dangerous`` faults of an arm: how many were ``caught`` before the harm, and ``averted``.

    ``caught_low`` and ``averted_low`` are lower bounds of these shares at the budget's confidence.
    """

    campaign: str
    arm: str
    scheme: str
    dangerous: int
    caught: int
    caught_low: float
    averted: int
    averted_low: float


def coverages(store: Store, campaigns: Sequence[Flown], confidence: float) -> list[DiagnosticCoverage]:
    """The coverage of each arm with a detector that has an arm without one beside it."""
    return [
        _coverage(store, campaign, pair, arm, confidence)
        for campaign, runs in campaigns
        for arm, pair in _pairs(campaign, runs).items()
    ]


def _pairs(
    campaign: CampaignEntry, runs: Sequence[FlightRecord]
) -> Mapping[str, list[tuple[FlightRecord, FlightRecord]]]:
    """Of each arm with a detector: the runs that harmed without it, and the same faults' with it."""
    beside = unprotected_arms(campaign.spec)
    by_place = {(run.cell, run.number): run for run in runs}
    found: dict[str, list[tuple[FlightRecord, FlightRecord]]] = {arm: [] for arm in beside}
    for run in runs:
        if run.cell.arm in beside:
            bare = by_place.get((run.cell._replace(arm=beside[run.cell.arm]), run.number))
            if bare is not None and _is_dangerous(bare) and run.result is not None:
                found[run.cell.arm].append((bare, run))
    return found


def _is_dangerous(run: FlightRecord) -> bool:
    return run.result is not None and run.result.injection == "injected" and bool(run.result.harm)


def _coverage(
    store: Store,
    campaign: CampaignEntry,
    pairs: Sequence[tuple[FlightRecord, FlightRecord]],
    arm: str,
    confidence: float,
) -> DiagnosticCoverage:
    caught = sum(_is_in_time(store, campaign, bare, watched) for bare, watched in pairs)
    averted = sum(is_averted(watched) for _, watched in pairs)
    return DiagnosticCoverage(
        campaign=campaign.label,
        arm=arm,
        scheme=_scheme(campaign, arm),
        dangerous=len(pairs),
        caught=caught,
        caught_low=lower_bound(caught, len(pairs), confidence),
        averted=averted,
        averted_low=lower_bound(averted, len(pairs), confidence),
    )


def is_averted(watched: FlightRecord) -> bool:
    """Whether the fault struck a flight with the detector and did not harm it."""
    found = watched.result
    return found is not None and found.injection == "injected" and found.harm == ""


def _is_in_time(store: Store, campaign: CampaignEntry, bare: FlightRecord, watched: FlightRecord) -> bool:
    """Whether an alarm of the fault came before the fault harmed the flight without a detector."""
    assert bare.result is not None  # noqa: S101 - it harmed
    stored = stored_run(store, campaign, watched.id)
    if stored is None or stored.outcome is None or stored.outcome.detection is None:
        return False
    alarms = [one.virtual_time_ns for one in stored.outcome.detection.alarms if one.true]
    harmed_s = bare.result.harmed_at_s
    return bool(alarms) and (harmed_s is None or min(alarms) / 1e9 < harmed_s)


def _scheme(campaign: CampaignEntry, arm: str) -> str:
    changes = next(one.mission for one in campaign.spec.arms if one.name == arm)
    own = (changes.get("detector") or {}).get("scheme")
    everywhere = campaign.spec.mission.detector
    return str(own or (everywhere.scheme if everywhere is not None else ""))
