"""What a campaign will take and what it can tell, before anything is flown."""

from __future__ import annotations

from pydantic import Field

from dashboard.campaigns.spec import CampaignSpec, cells, counted
from dashboard.campaigns.statistics.sampling import resolvable_drop
from dashboard.campaigns.store.store import Store
from services.models.base import Strict

FLIGHT_S = 1.5
"""Wall time of a flight in Sparse with the fast profile (README); until the store knows better."""

OUTCOME_BYTES = 6000
"""A flight's rows in the store, likewise."""

SUCCESS = 0.95
"""Success rate from which a drop is to be told (facts: golden flights of the paper's worlds)."""


class Forecast(Strict):
    """Estimated time, disk space and precision of a campaign."""

    cells: int
    runs: int
    twins: int = Field(description="golden twins that are no runs of their own")
    hours: float
    disk_mb: float
    per_cell: int
    resolvable_drop: float | None = Field(
        description="smallest drop of a success rate of 95 % that two cells can tell with 80 % power"
    )
    measured: bool = Field(description="whether the time comes from flights of this store")


def forecast(spec: CampaignSpec, store: Store, slots: int) -> Forecast:
    """Reckon a campaign, with what the store knows of earlier flights."""
    planned, twins = counted(spec)
    flights = planned + twins
    measured = store.wall_s(sorted({cell.world for cell in cells(spec)}))
    size = store.outcome_size() or OUTCOME_BYTES
    drop = resolvable_drop(spec.runs, SUCCESS)
    return Forecast(
        cells=len(cells(spec)),
        runs=planned,
        twins=twins,
        hours=flights * (measured or FLIGHT_S) / slots / 3600,
        disk_mb=round(planned * size * 1.5 / 1e6, 3),
        per_cell=spec.runs,
        resolvable_drop=drop,
        measured=measured is not None,
    )
