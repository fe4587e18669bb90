"""What a campaign has found so far, in numbers: summaries, boxes, and some flights to be drawn one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.results.summary import CellSummary, summarise
from dashboard.campaigns.spec import Cell, cells, unprotected_arms
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
    order = cells(found.spec)
    records = list(store.records(found))
    return Figures(summarise(order, records, unprotected_arms(found.spec)), flights(order, records))


def flights(order: Sequence[Cell], records: Sequence[FlightRecord]) -> list[CellFlights]:
    """Points of the flights of each cell."""
    found: dict[Cell, list[FlightRecord]] = {cell: [] for cell in order}
    for record in records:
        if record.result is not None:
            found[record.cell].append(record)
    most = max(MOST_DOTS // max(len(found), 1), 20)
    return [_cell(cell, members, most) for cell, members in found.items()]


def _cell(cell: Cell, records: Sequence[FlightRecord], most: int) -> CellFlights:
    results = [record.result for record in records if record.result is not None]
    arrived = [[getattr(one, name) for name in QUALITIES] for one in results if one.success]
    boxes = np.quantile(np.array(arrived), (0, 0.25, 0.5, 0.75, 1), axis=0).T if arrived else None
    step = -(-len(records) // most) or 1
    return CellFlights(
        cell=cell,
        flown=len(records),
        results=Counter(one.result for one in results),
        boxes=tuple(tuple(map(float, box)) for box in boxes) if boxes is not None else None,
        dots=[_dot(record) for record in records[::step]],
    )


def _dot(record: FlightRecord) -> Dot:
    assert record.result is not None  # noqa: S101 - only flown ones are drawn
    values = tuple(float(getattr(record.result, name)) for name in QUALITIES)
    return Dot(record.id, record.number, record.result.success, values)
