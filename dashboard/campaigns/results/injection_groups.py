"""The injected flights of a campaign, grouped by what the fault corrupted."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import sqlalchemy as sa

from dashboard.campaigns.statistics.proportions import wilson
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.schema import OutcomeRow, ResultRow, RunRow
from dashboard.campaigns.store.store import Store
from services.models.base import Strict
from services.models.outcome import InjectionRecord


@dataclass(frozen=True, slots=True)
class InjectedFlight:
    """An injected flight: its injection, whether the mission succeeded, the outcome of the node."""

    record: InjectionRecord
    success: bool
    node_result: str

    @property
    def target(self) -> str:
        """The kernel, or the states that were corrupted in a message."""
        return self.record.kernel or ", ".join(self.record.state)


class InjectionGroup(Strict):
    """Injected flights that have ``name`` in common, and how many of their missions failed (Wilson, 95 %)."""

    name: str
    injected: int
    failed: int
    low: float
    high: float
    results: dict[str, int]


def injected_flights(store: Store, found: CampaignEntry) -> list[InjectedFlight]:
    """Every injected flight of a campaign, in the order of planning."""
    # PostgreSQL has a type for JSON, SQLite has functions for its text.
    text = store.database.engine.dialect.name == "sqlite"
    outcome = (sa.type_coerce if text else sa.cast)(OutcomeRow.outcome, sa.JSON)
    query = (
        sa.select(outcome["injection"].as_string(), ResultRow.success, ResultRow.node_result)
        .join(RunRow, RunRow.id == ResultRow.run_id)
        .join(OutcomeRow, OutcomeRow.run_id == ResultRow.run_id)
        .where(RunRow.campaign_id == found.id, ResultRow.injection == "injected")
        .order_by(RunRow.id)
    )
    with store.reading() as connection:
        rows = connection.execute(query).all()
    return [
        InjectedFlight(InjectionRecord.model_validate_json(record), success, node)
        for record, success, node in rows
    ]


def grouped(found: Sequence[InjectedFlight], name: Callable[[InjectedFlight], str]) -> list[InjectionGroup]:
    """Group injected flights by ``name``; the largest group first."""
    groups: dict[str, list[InjectedFlight]] = defaultdict(list)
    for flight in found:
        groups[name(flight)].append(flight)
    told = [_group(label, members) for label, members in groups.items()]
    return sorted(told, key=lambda group: (-group.injected, group.name))


def _group(name: str, members: Sequence[InjectedFlight]) -> InjectionGroup:
    failed = sum(not flight.success for flight in members)
    low, high = wilson(failed, len(members))
    results: dict[str, int] = {}
    for flight in members:
        results[flight.node_result] = results.get(flight.node_result, 0) + 1
    return InjectionGroup(
        name=name,
        injected=len(members),
        failed=failed,
        low=low,
        high=high,
        results=dict(sorted(results.items())),
    )
