"""The injected flights of a campaign, grouped by what the fault corrupted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from dashboard.campaigns.statistics.proportions import wilson
from dashboard.campaigns.store.queries import CampaignEntry, outcome_fields
from dashboard.campaigns.store.schema import OutcomeRow, ResultRow, RunRow
from dashboard.campaigns.store.store import Store
from services.models.base import Strict
from services.models.outcome import InjectionRecord

Ways = Mapping[str, Callable[[InjectionRecord], str]]
"""By what injections can be divided: the name of a record's group, by the way's name."""

TARGET = "target"
"""The way that is always there: the kernel, or the states that were corrupted in a message."""

BETWEEN = "\0"
"""Between the names of a group that is one of several ways."""

_RESULT = "node_result"


class InjectionGroup(Strict):
    """Injected flights that have ``name`` in common, and how many of their missions failed (Wilson, 95 %)."""

    name: str
    injected: int
    failed: int
    low: float
    high: float
    results: dict[str, int]


@dataclass(frozen=True, slots=True)
class InjectionTable:
    """Injected flights as numbers: of each way, the place of the flight's name in ``names``."""

    rows: NDArray[np.void]
    names: Mapping[str, Sequence[str]]

    def __len__(self) -> int:
        return len(self.rows)

    def grouped(self, *ways: str, of_kernels: bool = False) -> list[InjectionGroup]:
        """Group the flights, or those whose fault struck a kernel; the largest group first."""
        rows = self.rows[self.rows["of_kernel"]] if of_kernels else self.rows
        if not len(rows):
            return []
        shape = tuple(len(self.names[way]) for way in ways)
        codes = np.ravel_multi_index(tuple(rows[way] for way in ways), shape)
        found, group = np.unique(codes, return_inverse=True)
        ends = self.names[_RESULT]
        ended = np.zeros((len(found), len(ends)), np.int64)
        np.add.at(ended, (group, rows[_RESULT]), 1)
        failed = np.bincount(group, ~rows["success"], len(found)).astype(np.int64)
        groups = []
        for place, code in enumerate(found):
            at = np.unravel_index(code, shape)
            name = BETWEEN.join(self.names[way][one] for way, one in zip(ways, at, strict=True))
            results = {end: count for end, count in zip(ends, ended[place].tolist(), strict=True) if count}
            groups.append(_group(name, int(failed[place]), results))
        return sorted(groups, key=lambda one: (-one.injected, one.name))


class InjectedFlights:
    """The injected flights of one campaign, kept up to date: what was read once is not read again.

    Of a record no more is kept than the names of its groups: a campaign may have 100,000, of 5 kB each.
    """

    def __init__(self, ways: Ways) -> None:
        self._ways = {TARGET: _target, **ways}
        self._codes: dict[str, dict[str, int]] = {name: {} for name in (*self._ways, _RESULT)}
        ways_type = [(name, "i4") for name in self._codes]
        self._type = np.dtype([("id", "i8"), ("success", "?"), ("of_kernel", "?"), *ways_type])
        self._rows: NDArray[np.void] = np.empty(0, self._type)
        self._campaign, self._write = -1, -1

    def read(self, store: Store, found: CampaignEntry) -> InjectionTable:
        """Those that the campaign has now, in the order of planning; by one thread at a time."""
        if found.id != self._campaign:
            self._campaign, self._write, self._rows = found.id, -1, self._rows[:0]
        with store.reading() as connection:
            changed = connection.execute(_query(store), {"campaign": found.id, "write": self._write}).all()
        if changed:
            new = [self._row(number, *told) for _, number, *told in changed if told[0] is not None]
            kept = self._rows[~np.isin(self._rows["id"], [number for _, number, *_ in changed])]
            rows = np.concatenate([kept, np.array(new, self._type)])
            self._rows = rows[np.argsort(rows["id"])]
            self._write = max(write for write, *_ in changed)
        return InjectionTable(self._rows, {name: list(codes) for name, codes in self._codes.items()})

    def _row(self, number: int, record: str, success: bool, node_result: str) -> tuple[object, ...]:
        told = InjectionRecord.model_validate_json(record)
        names = {**{way: name(told) for way, name in self._ways.items()}, _RESULT: node_result}
        codes = (self._codes[way].setdefault(name, len(self._codes[way])) for way, name in names.items())
        return (number, success, bool(told.kernel), *codes)


def _target(record: InjectionRecord) -> str:
    return record.kernel or ", ".join(record.state)


def _query(store: Store) -> sa.Select[Any]:
    """Write, id, record, success and node result of the runs that changed; no record if none was injected."""
    outcome = outcome_fields(store.database)
    injected = sa.and_(OutcomeRow.run_id == RunRow.id, ResultRow.injection == "injected")
    return (
        sa.select(
            RunRow.changed,
            RunRow.id,
            outcome["injection"].as_string(),
            ResultRow.success,
            ResultRow.node_result,
        )
        .join(ResultRow, ResultRow.run_id == RunRow.id, isouter=True)
        .join(OutcomeRow, injected, isouter=True)
        .where(RunRow.campaign_id == sa.bindparam("campaign"), RunRow.changed > sa.bindparam("write"))
        .order_by(RunRow.id)
    )


def _group(name: str, failed: int, results: dict[str, int]) -> InjectionGroup:
    injected = sum(results.values())
    low, high = wilson(failed, injected)
    ordered = dict(sorted(results.items()))
    return InjectionGroup(name=name, injected=injected, failed=failed, low=low, high=high, results=ordered)
