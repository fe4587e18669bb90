"""What the faults of a campaign struck, and how their flights ended."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import sqlalchemy as sa

from dashboard.campaigns.schema import ResultRow, RunRow
from dashboard.campaigns.statistics.proportions import wilson
from dashboard.campaigns.store import Campaign, Store
from services.bus.model import Strict
from services.bus.outcome import InjectionRecord


@dataclass(frozen=True, slots=True)
class Strike:
    """An injected flight: what was struck, whether the mission succeeded, what became of the node."""

    record: InjectionRecord
    success: bool
    node_result: str

    @property
    def target(self) -> str:
        """The kernel, or the states that were struck in a message."""
        return self.record.kernel or ", ".join(self.record.state)


class StrikeGroup(Strict):
    """Injected flights that have ``name`` in common, and how many of their missions failed (Wilson, 95 %)."""

    name: str
    injected: int
    failed: int
    low: float
    high: float
    results: dict[str, int]


def strikes(store: Store, found: Campaign) -> list[Strike]:
    """Every injected flight of a campaign, in the order of planning."""
    # PostgreSQL has a type for JSON, SQLite has functions for its text.
    text = store.database.engine.dialect.name == "sqlite"
    outcome = (sa.type_coerce if text else sa.cast)(ResultRow.outcome, sa.JSON)
    query = (
        sa.select(outcome["injection"].as_string(), ResultRow.success, ResultRow.node_result)
        .join(RunRow, RunRow.id == ResultRow.run_id)
        .where(RunRow.campaign_id == found.id, ResultRow.injection == "injected")
        .order_by(RunRow.id)
    )
    with store.reading() as connection:
        rows = connection.execute(query).all()
    return [
        Strike(InjectionRecord.model_validate_json(record), success, node) for record, success, node in rows
    ]


def grouped(found: Sequence[Strike], name: Callable[[Strike], str]) -> list[StrikeGroup]:
    """The strikes by name, the most frequent first."""
    groups: dict[str, list[Strike]] = defaultdict(list)
    for strike in found:
        groups[name(strike)].append(strike)
    told = [_group(label, members) for label, members in groups.items()]
    return sorted(told, key=lambda group: (-group.injected, group.name))


def _group(name: str, members: Sequence[Strike]) -> StrikeGroup:
    failed = sum(not strike.success for strike in members)
    low, high = wilson(failed, len(members))
    results: dict[str, int] = {}
    for strike in members:
        results[strike.node_result] = results.get(strike.node_result, 0) + 1
    return StrikeGroup(
        name=name,
        injected=len(members),
        failed=failed,
        low=low,
        high=high,
        results=dict(sorted(results.items())),
    )
