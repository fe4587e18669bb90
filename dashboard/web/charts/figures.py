"""What a campaign has found so far, in numbers: summaries, boxes, and some flights to be drawn one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dashboard.campaigns.results.summary import CellSummary, summarise
from dashboard.campaigns.spec import Cell, cells, unprotected_arms
from dashboard.campaigns.store.columns import Rows, by_cell
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store

MOST_DOTS = 1200
"""Flights drawn one by one; of more, every so-many-th of a cell."""

QUALITIES = ("flight_time_s", "distance_m", "energy_kj")


@dataclass(frozen=True, slots=True)
class Dot:
    """One flight as a point of a plot."""

    run: int
    number: int
    success: bool
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class CellFlights:
    """The flights of a cell: their results, five-number boxes of the successful ones, and some as dots.

    ``boxes`` has one for each of :data:`QUALITIES`, None without a success.
    """

    cell: Cell
    flown: int
    results: Counter[str]
    boxes: tuple[tuple[float, ...], ...] | None
    dots: list[Dot]


@dataclass(frozen=True, slots=True)
class Figures:
    """What a campaign has found so far."""

    summary: list[CellSummary]
    flights: list[CellFlights]


def figures(store: Store, found: CampaignEntry) -> Figures:
    """Compute the summary and the points of a campaign."""
    order, runs = cells(found.spec), store.columns(found)
    return Figures(summarise(order, runs, unprotected_arms(found.spec)), flights(order, runs))


def flights(order: Sequence[Cell], runs: Rows) -> list[CellFlights]:
    """Points of the flights of each cell."""
    most = max(MOST_DOTS // max(len(order), 1), 20)
    return [
        _cell(cell, runs, members, most)
        for cell, members in zip(order, by_cell(runs, len(order)), strict=True)
    ]


def _cell(cell: Cell, runs: Rows, members: NDArray[np.int64], most: int) -> CellFlights:
    flown = members[runs["result"][members] != None]  # noqa: E711 - of each element
    arrived = flown[runs["success"][flown]]
    values = np.array([runs[name][arrived] for name in QUALITIES])
    boxes = np.quantile(values, (0, 0.25, 0.5, 0.75, 1), axis=1).T if values.size else None
    step = -(-len(flown) // most) or 1
    return CellFlights(
        cell=cell,
        flown=len(flown),
        results=Counter(runs["result"][flown]),
        boxes=tuple(tuple(map(float, box)) for box in boxes) if boxes is not None else None,
        dots=[_dot(runs[run]) for run in flown[::step]],
    )


def _dot(run: np.void) -> Dot:
    values = tuple(float(run[name]) for name in QUALITIES)
    return Dot(int(run["id"]), int(run["number"]), bool(run["success"]), values)
