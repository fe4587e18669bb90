"""Flights beside other flights of the same seeds: does success change, and what does it cost?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dashboard.campaigns.spec import Cell, cells
from dashboard.campaigns.statistics.differences import quantile_interval
from dashboard.campaigns.statistics.proportions import Interval, Pairs, holm, mcnemar, newcombe_paired
from dashboard.campaigns.store.columns import Rows, by_cell, partners
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError
from services.models.base import Strict

SEED = 0
"""Of the bootstrap: the same flights give the same intervals."""

MEASURES = ("flight_time_s", "distance_m", "energy_kj")
"""Quantities whose differences are told."""


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


@dataclass(frozen=True, slots=True)
class Paired:
    """A cell, the name of its reference, and which of its pairs succeeded.

    ``differences`` has one row for each of :data:`MEASURES` and a column for each pair in which both arrived.
    """

    cell: Cell
    reference: str
    own: NDArray[np.bool_]
    others: NDArray[np.bool_]
    differences: NDArray[np.float64]


def with_twins(cells: Sequence[Cell], runs: Rows) -> list[Paired]:
    """Each cell with faults beside its golden twins."""
    told = []
    for cell, members in zip(cells, by_cell(runs, len(cells)), strict=True):
        own = members[~np.isnan(runs["twin_success"][members])]
        if len(own):
            told.append(_paired(cell, "golden twins", runs, own, runs, own, "twin_"))
    return told


def with_others(
    cells: Sequence[Cell], runs: Rows, others: Rows, reference: str, cell_of: Sequence[int]
) -> list[Paired]:
    """Each cell beside the cell of ``others`` at the place ``cell_of`` says, -1 for none.

    Runs of one number and seed are pairs.
    """
    beside = partners(runs, others, cell_of)
    flown = (runs["result"] != None) & (beside >= 0)  # noqa: E711 - of each element
    flown[flown] = others["result"][beside[flown]] != None  # noqa: E711
    told = []
    for cell, members in zip(cells, by_cell(runs, len(cells)), strict=True):
        own = members[flown[members]]
        if len(own):
            told.append(_paired(cell, reference, runs, own, others, beside[own]))
    return told


def _paired(
    cell: Cell,
    reference: str,
    runs: Rows,
    own: NDArray[np.int64],
    others: Rows,
    other: NDArray[np.int64],
    prefix: str = "",
) -> Paired:
    """The pairs of ``runs[own]`` and ``others[other]``, whose columns have names with a prefix."""
    arrived, others_arrived = runs["success"][own], others[f"{prefix}success"][other] == 1
    both = arrived & others_arrived
    own, other = own[both], other[both]
    differences = [runs[name][own] - others[f"{prefix}{name}"][other] for name in MEASURES]
    return Paired(cell, reference, arrived, others_arrived, np.array(differences))


def compare(paired: Sequence[Paired]) -> list[Comparison]:
    """Every cell beside its reference, p-values adjusted for how many they are."""
    counts = [Pairs.of(one.own, one.others) for one in paired]
    p_values = [mcnemar(count) for count in counts]
    return [
        _comparison(one, count, p_value, adjusted)
        for one, count, p_value, adjusted in zip(paired, counts, p_values, holm(p_values), strict=True)
    ]


def _comparison(one: Paired, count: Pairs, p_value: float, adjusted: float) -> Comparison:
    pairs = sum(count)
    return Comparison(
        cell=str(one.cell),
        reference=one.reference,
        pairs=pairs,
        successes=count.both + count.first_only,
        reference_successes=count.both + count.second_only,
        success_difference=(count.first_only - count.second_only) / pairs if pairs else None,
        success_interval=newcombe_paired(count),
        p_value=p_value,
        p_adjusted=adjusted,
        **dict(zip(MEASURES, map(_difference, one.differences), strict=True)),
    )


def _difference(values: NDArray[np.float64]) -> Difference:
    if not len(values):
        return Difference(pairs=0)
    return Difference(
        pairs=len(values),
        median=float(np.median(values)),
        median_interval=quantile_interval(values, 0.5, SEED),
        p95=float(np.quantile(values, 0.95, method="weibull")),
        p95_interval=quantile_interval(values, 0.95, SEED),
    )


def side_by_side(
    store: Store, campaign: CampaignEntry, other: CampaignEntry | None, against: str | None
) -> list[Comparison]:
    """Each cell beside its golden twins, the cell of its name in ``other``, or that of the arm ``against``.

    :raises BadSpecError: if there is no such arm.
    """
    order, runs = cells(campaign.spec), store.columns(campaign)
    if other is not None:
        theirs = cells(other.spec)
        return compare(
            with_others(
                order, runs, store.columns(other), other.label, _places(theirs, lambda one: one, order)
            )
        )
    if against is None:
        return compare(with_twins(order, runs))
    arms = [arm.name for arm in campaign.spec.arms]
    if against not in arms:
        message = f"--against: no arm {against!r}; the arms are {', '.join(arms)}"
        raise BadSpecError(message)
    match = [
        -1 if cell.arm == against else place
        for cell, place in zip(
            order, _places(order, lambda one: one._replace(arm=against), order), strict=True
        )
    ]
    return compare(with_others(order, runs, runs, against, match))


def _places(theirs: Sequence[Cell], match: Callable[[Cell], Cell], cells: Sequence[Cell]) -> list[int]:
    """Where among ``theirs`` the match of each of ``cells`` is, or -1."""
    places = {cell: place for place, cell in enumerate(theirs)}
    return [places.get(match(cell), -1) for cell in cells]
