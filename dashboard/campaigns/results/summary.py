"""What a campaign says: quality of flight per cell, with intervals and counted denominators."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dashboard.campaigns.results.detection_effects import EFFECTS, NO_EFFECT, Effect, effects
from dashboard.campaigns.spec import Cell, cells, unprotected_arms
from dashboard.campaigns.statistics.proportions import median_interval, wilson
from dashboard.campaigns.store.columns import Rows, by_cell
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
    return summarise(cells(found.spec), store.columns(found), unprotected_arms(found.spec))


def summarise(cells: Sequence[Cell], runs: Rows, unprotected: Mapping[str, str]) -> list[CellSummary]:
    """One line per cell, in the order of ``cells``; ``unprotected`` is each arm's arm without a detector."""
    made = effects(cells, runs, unprotected)
    return [
        _summary(cell, runs, members, made[members])
        for cell, members in zip(cells, by_cell(runs, len(cells)), strict=True)
    ]


def _summary(cell: Cell, runs: Rows, members: NDArray[np.int64], made: NDArray[np.int64]) -> CellSummary:
    # Column by column: to copy rows of 200 bytes takes longer than all that is computed of them.
    flown = members[runs["result"][members] != None]  # noqa: E711 - of each element
    failed = int(np.count_nonzero(runs["phase"][members] == "failed"))
    arrived = flown[runs["success"][flown]]
    injections = runs["injection"][flown]
    injected = flown[injections == "injected"]
    harm = runs["harm"][injected]
    known = harm[harm != None]  # noqa: E711
    low, high = wilson(len(arrived), len(flown))
    words = np.bincount(made[made != NO_EFFECT], minlength=len(EFFECTS))
    energy_kj = float(runs["energy_kj"][flown].sum())
    return CellSummary(
        **cell._asdict(),
        planned=len(members),
        runs=len(flown) + failed,
        failed_to_fly=failed,
        successes=len(arrived),
        success_low=low,
        success_high=high,
        **_median("flight_time", "s", runs["flight_time_s"][arrived]),
        **_median("distance", "m", runs["distance_m"][arrived]),
        **_median("energy", "kj", runs["energy_kj"][arrived]),
        energy_per_success_kj=energy_kj / len(arrived) if len(arrived) else None,
        replans=float(runs["replans"][arrived].mean()) if len(arrived) else None,
        aimed=int(np.count_nonzero(injections != "")),
        injected=len(injected),
        proven=int(np.count_nonzero(runs["proof"][flown] != "")),
        results=dict(sorted(Counter(runs["node_result"][injected]).items())),
        harmed=int(np.count_nonzero(known != "")) if len(known) else None,
        effects=dict(zip(EFFECTS, map(int, words), strict=True)) if words.any() else {},
    )


def _median(name: str, unit: str, values: NDArray[np.float64]) -> dict[str, Any]:
    """The median and both ends of its interval, by the names of their fields."""
    low, high = median_interval(values) or (None, None)
    return {
        f"{name}_{unit}": float(np.median(values)) if len(values) else None,
        f"{name}_low_{unit}": low,
        f"{name}_high_{unit}": high,
    }
