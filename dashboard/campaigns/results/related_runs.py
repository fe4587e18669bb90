"""Runs that have much in common with another: all but their arm, or every message."""

from __future__ import annotations

from dataclasses import dataclass

import sqlalchemy as sa

from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.schema import ResultRow, RunRow
from dashboard.campaigns.store.store import Store


@dataclass(frozen=True, slots=True)
class RelatedRun:
    """A run of another arm; ``result`` is empty as long as it has none."""

    id: int
    arm: str
    result: str


def related_runs(store: Store, campaign: CampaignEntry, run: int) -> list[RelatedRun]:
    """The same flight in the other arms, in the order of planning; none if there is no such run."""
    this = sa.select(RunRow.world, RunRow.fault, RunRow.number).where(
        RunRow.campaign_id == campaign.id, RunRow.id == run
    )
    query = (
        sa.select(RunRow.id, RunRow.arm, ResultRow.result)
        .join(ResultRow, ResultRow.run_id == RunRow.id, isouter=True)
        .where(
            RunRow.campaign_id == campaign.id,
            RunRow.id != run,
            sa.tuple_(RunRow.world, RunRow.fault, RunRow.number).in_(this),
        )
        .order_by(RunRow.id)
    )
    with store.reading() as connection:
        return [RelatedRun(row.id, row.arm, row.result or "") for row in connection.execute(query)]


def same_flights(store: Store, campaign: CampaignEntry, digest: str) -> list[int]:
    """Runs whose flight has this digest: the same to the bit, such as a golden twin that an arm flew too."""
    query = (
        sa.select(RunRow.id)
        .join(ResultRow, ResultRow.run_id == RunRow.id)
        .where(RunRow.campaign_id == campaign.id, ResultRow.digest == digest)
        .order_by(RunRow.id)
    )
    with store.reading() as connection:
        return list(connection.execute(query).scalars())
