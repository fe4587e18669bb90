"""What a campaign says: quality of flight per cell, with intervals and counted denominators."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pydantic import Field

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.results.detection_effects import EFFECTS, Effect, effects
from dashboard.campaigns.spec import Cell, cells, unprotected_arms
from dashboard.campaigns.statistics.proportions import median_interval, wilson
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from services.models.base import Strict


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
    flight_time_low_s: float | None = Field(description="of its 95 % interval; none with fewer than six")
    flight_time_high_s: float | None
    distance_m: float | None
    distance_low_m: float | None
    distance_high_m: float | None
    energy_kj: float | None
    energy_low_kj: float | None
    energy_high_kj: float | None
    energy_per_success_kj: float | None = Field(description="of all flights, over the successes")
    replans: float | None
    aimed: int = Field(description="flown with a fault")
    injected: int = Field(description="of those, the fault was there when read back")
    proven: int = Field(description="of the runs, whose outcome was proven and not flown")
    results: dict[str, int] = Field(description="of the node aimed at, of the injected flights")
    harmed: int | None = Field(description="of the injected flights; none where it is not known of any")
    effects: dict[Effect, int] = Field(description="what the detector made of the faults, if there is one")


def summary(store: Store, found: CampaignEntry) -> list[CellSummary]:
    """What a campaign has found so far."""
    return summarise(cells(found.spec), store.records(found), unprotected_arms(found.spec))


def summarise(
    cells: Sequence[Cell], records: Iterable[FlightRecord], unprotected: Mapping[str, str]
) -> list[CellSummary]:
    """One line per cell, in the order of ``cells``; ``unprotected`` is each arm's arm without a detector."""
    found: dict[Cell, list[FlightRecord]] = {cell: [] for cell in cells}
    for record in records:
        found[record.cell].append(record)
    made: dict[Cell, Counter[Effect]] = {cell: Counter() for cell in cells}
    for record, word in effects((one for runs in found.values() for one in runs), unprotected):
        made[record.cell][word] += 1
    return [_summary(cell, runs, made[cell]) for cell, runs in found.items()]


def _summary(cell: Cell, records: Sequence[FlightRecord], made: Counter[Effect]) -> CellSummary:
    flown = [record.result for record in records if record.result is not None]
    failed = sum(record.phase == "failed" for record in records)
    arrived = [result for result in flown if result.success]
    injected = [result for result in flown if result.injection == "injected"]
    known = [result for result in injected if result.harm is not None]
    low, high = wilson(len(arrived), len(flown))
    return CellSummary(
        **cell._asdict(),
        planned=len(records),
        runs=len(flown) + failed,
        failed_to_fly=failed,
        successes=len(arrived),
        success_low=low,
        success_high=high,
        **_median("flight_time", "s", [result.flight_time_s for result in arrived]),
        **_median("distance", "m", [result.distance_m for result in arrived]),
        **_median("energy", "kj", [result.energy_kj for result in arrived]),
        energy_per_success_kj=sum(one.energy_kj for one in flown) / len(arrived) if arrived else None,
        replans=statistics.mean([result.replans for result in arrived]) if arrived else None,
        aimed=sum(result.injection != "" for result in flown),
        injected=len(injected),
        proven=sum(result.proof != "" for result in flown),
        results=_counted(injected),
        harmed=sum(one.harm != "" for one in known) if known else None,
        effects={word: made[word] for word in EFFECTS if made},
    )


def _counted(injected: Sequence[Result]) -> dict[str, int]:
    return dict(sorted(Counter(result.node_result for result in injected).items()))


def _median(name: str, unit: str, values: Sequence[float]) -> dict[str, Any]:
    """The median and both ends of its interval, by the names of their fields."""
    low, high = median_interval(values) or (None, None)
    return {
        f"{name}_{unit}": statistics.median(values) if values else None,
        f"{name}_low_{unit}": low,
        f"{name}_high_{unit}": high,
    }
