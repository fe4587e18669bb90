"""Flights beside other flights of the same seeds: does success change, and what does it cost?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from pydantic import Field

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.spec import Cell
from dashboard.campaigns.statistics.differences import quantile_interval
from dashboard.campaigns.statistics.proportions import Interval, Pairs, holm, mcnemar, newcombe_paired
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError
from services.models.base import Strict

SEED = 0
"""Of the bootstrap: the same flights give the same intervals."""


class Quality(NamedTuple):
    """What is compared of a flight."""

    success: bool
    flight_time_s: float
    distance_m: float
    energy_kj: float


class Difference(Strict):
    """Paired difference of a quantity over the pairs that both arrived, with bootstrap intervals."""

    pairs: int
    median: float | None = None
    median_interval: Interval | None = None
    p95: float | None = None
    p95_interval: Interval | None = None


class Comparison(Strict):
    """One cell beside its reference. Differences are the cell's less the reference's."""

    cell: str
    reference: str
    pairs: int
    successes: int
    reference_successes: int
    success_difference: float | None
    success_interval: Interval
    p_value: float = Field(description="exact McNemar")
    p_adjusted: float = Field(description="Holm, over all cells compared")
    flight_time_s: Difference
    distance_m: Difference
    energy_kj: Difference


Paired = tuple[Cell, str, list[tuple[Quality, Quality]]]
"""A cell, the name of its reference, and the pairs."""


def with_twins(records: Sequence[FlightRecord]) -> list[Paired]:
    """Each cell with faults beside its golden twins."""
    found: dict[Cell, list[tuple[Quality, Quality]]] = {}
    for record in records:
        if record.result is not None and record.result.twin_success is not None:
            found.setdefault(record.cell, []).append((_own(record.result), _twin(record.result)))
    return [(cell, "golden twins", pairs) for cell, pairs in found.items()]


def with_others(
    records: Sequence[FlightRecord],
    others: Sequence[FlightRecord],
    reference: str,
    match: Callable[[Cell], Cell],
) -> list[Paired]:
    """Each cell beside the cell of ``others`` that ``match`` names; runs of one number and seed are pairs."""
    flown = {
        (other.cell, other.number, other.seed): other.result for other in others if other.result is not None
    }
    found: dict[Cell, list[tuple[Quality, Quality]]] = {}
    for record in records:
        other = flown.get((match(record.cell), record.number, record.seed))
        if record.result is not None and other is not None:
            found.setdefault(record.cell, []).append((_own(record.result), _own(other)))
    return [(cell, reference, pairs) for cell, pairs in found.items()]


def compare(paired: Sequence[Paired]) -> list[Comparison]:
    """Every cell beside its reference, p-values adjusted for how many they are."""
    counts = [Pairs.of([a.success for a, _ in pairs], [b.success for _, b in pairs]) for *_, pairs in paired]
    p_values = [mcnemar(count) for count in counts]
    return [
        _comparison(one, count, p_value, adjusted)
        for one, count, p_value, adjusted in zip(paired, counts, p_values, holm(p_values), strict=True)
    ]


def _comparison(one: Paired, count: Pairs, p_value: float, adjusted: float) -> Comparison:
    cell, reference, pairs = one
    return Comparison(
        cell=str(cell),
        reference=reference,
        pairs=len(pairs),
        successes=count.both + count.first_only,
        reference_successes=count.both + count.second_only,
        success_difference=(count.first_only - count.second_only) / len(pairs) if pairs else None,
        success_interval=newcombe_paired(count),
        p_value=p_value,
        p_adjusted=adjusted,
        flight_time_s=_difference([(a.flight_time_s, b.flight_time_s) for a, b in _arrived(pairs)]),
        distance_m=_difference([(a.distance_m, b.distance_m) for a, b in _arrived(pairs)]),
        energy_kj=_difference([(a.energy_kj, b.energy_kj) for a, b in _arrived(pairs)]),
    )


def _arrived(pairs: Sequence[tuple[Quality, Quality]]) -> list[tuple[Quality, Quality]]:
    return [(a, b) for a, b in pairs if a.success and b.success]


def _difference(pairs: Sequence[tuple[float, float]]) -> Difference:
    values = [a - b for a, b in pairs]
    if not values:
        return Difference(pairs=0)
    return Difference(
        pairs=len(values),
        median=float(np.median(values)),
        median_interval=quantile_interval(values, 0.5, SEED),
        p95=float(np.quantile(values, 0.95, method="weibull")),
        p95_interval=quantile_interval(values, 0.95, SEED),
    )


def _own(result: Result) -> Quality:
    return Quality(result.success, result.flight_time_s, result.distance_m, result.energy_kj)


def _twin(result: Result) -> Quality:
    return Quality(
        bool(result.twin_success),
        result.twin_flight_time_s or 0.0,
        result.twin_distance_m or 0.0,
        result.twin_energy_kj or 0.0,
    )


def side_by_side(
    store: Store, campaign: CampaignEntry, other: CampaignEntry | None, against: str | None
) -> list[Comparison]:
    """Each cell beside its golden twins, the cell of its name in ``other``, or that of the arm ``against``.

    :raises BadSpecError: if there is no such arm.
    """
    records = list(store.records(campaign))
    if other is not None:
        return compare(with_others(records, list(store.records(other)), other.label, lambda cell: cell))
    if against is None:
        return compare(with_twins(records))
    arms = [arm.name for arm in campaign.spec.arms]
    if against not in arms:
        message = f"--against: no arm {against!r}; the arms are {', '.join(arms)}"
        raise BadSpecError(message)
    others = [record for record in records if record.cell.arm != against]
    return compare(with_others(others, records, against, lambda cell: cell._replace(arm=against)))
