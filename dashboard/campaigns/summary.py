"""What a campaign says: quality of flight per cell, with intervals and counted denominators."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Sequence

from pydantic import Field

from dashboard.campaigns.records import Record, Result
from dashboard.campaigns.spec import Cell
from dashboard.campaigns.statistics.proportions import wilson
from services.bus.model import Strict


class CellSummary(Strict):
    """One cell. Times, distances and energies are medians over the successful flights."""

    arm: str
    world: str
    fault: str
    planned: int
    runs: int = Field(description="attempted: flown, or failed to fly")
    failed_to_fly: int
    successes: int
    success_low: float
    success_high: float
    flight_time_s: float | None
    distance_m: float | None
    energy_kj: float | None
    energy_per_success_kj: float | None = Field(description="of all flights, over the successes")
    replans: float | None
    aimed: int = Field(description="flown with a fault")
    injected: int = Field(description="of those, the fault was there when read back")
    results: dict[str, int] = Field(description="of the node aimed at, of the injected flights")


def summarise(cells: Sequence[Cell], records: Iterable[Record]) -> list[CellSummary]:
    """One line per cell, in the order of ``cells``."""
    found: dict[Cell, list[Record]] = {cell: [] for cell in cells}
    for record in records:
        found[record.cell].append(record)
    return [_summary(cell, runs) for cell, runs in found.items()]


def _summary(cell: Cell, records: Sequence[Record]) -> CellSummary:
    flown = [record.result for record in records if record.result is not None]
    failed = sum(record.phase == "failed" for record in records)
    arrived = [result for result in flown if result.success]
    injected = [result for result in flown if result.injection == "injected"]
    low, high = wilson(len(arrived), len(flown))
    return CellSummary(
        **cell._asdict(),
        planned=len(records),
        runs=len(flown) + failed,
        failed_to_fly=failed,
        successes=len(arrived),
        success_low=low,
        success_high=high,
        flight_time_s=_median([result.flight_time_s for result in arrived]),
        distance_m=_median([result.distance_m for result in arrived]),
        energy_kj=_median([result.energy_kj for result in arrived]),
        energy_per_success_kj=sum(one.energy_kj for one in flown) / len(arrived) if arrived else None,
        replans=statistics.mean([result.replans for result in arrived]) if arrived else None,
        aimed=sum(result.injection != "" for result in flown),
        injected=len(injected),
        results=_counted(injected),
    )


def _counted(injected: Sequence[Result]) -> dict[str, int]:
    return dict(sorted(Counter(result.node_result for result in injected).items()))


def _median(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None
