"""The runs of a campaign as one array, kept up to date: what tables, comparisons and figures compute from.

A campaign may have 100,000 runs, and its tables are looked at again and again while it flies. The runs that
were read once are kept; each of them says in which write of its campaign it changed, so that only what
changed since is read.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.spec import Cell
from dashboard.campaigns.store.database import Database
from dashboard.campaigns.store.schema import ResultRow, RunRow

COLUMNS = np.dtype(
    [
        *(("id", "i8"), ("cell", "i8"), ("number", "i8"), ("seed", "i8"), ("phase", "O")),
        *(("result", "O"), ("success", "?"), ("flight_time_s", "f8"), ("distance_m", "f8")),
        *(("energy_kj", "f8"), ("replans", "f8"), ("injection", "O"), ("node_result", "O")),
        *(("twin_result", "O"), ("twin_success", "f8"), ("twin_flight_time_s", "f8")),
        *(("twin_distance_m", "f8"), ("twin_energy_kj", "f8"), ("alarms", "f8"), ("recomputed", "f8")),
        *(("harm", "O"), ("proof", "O"), ("artefact", "O"), ("artefact_bytes", "f8")),
        *(("has_twin", "?"), ("as_twin", "?")),
    ]
)
"""One element a run. ``cell`` is the place of its cell in the specification's order.

``result`` is None of a run that was not flown, and what is not known of a flight is None or nan.
``has_twin``: its golden twin's digest is known; ``as_twin``: and it is the flight's own.
"""

Rows = NDArray[np.void]

MOST_ROWS = 500_000
"""Runs that are kept in memory, of all campaigns; 300 bytes each."""

_OF_RUN = ("number", "seed", "phase")
_OF_RESULT = COLUMNS.names[5:-2] if COLUMNS.names else ()


@dataclass(slots=True)
class _Kept:
    rows: Rows
    write: int = -1
    """The last write of the campaign that was read."""
    lock: threading.Lock = field(default_factory=threading.Lock)


class RunColumns:
    """Reads the runs of campaigns, and keeps those that were asked for last; for any number of threads."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._kept: OrderedDict[int, _Kept] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, campaign: int, cells: Sequence[Cell]) -> Rows:
        """The runs of a campaign as they are now, in the order of planning. Do not change the array."""
        with self._lock:
            kept = self._kept.setdefault(campaign, _Kept(np.empty(0, COLUMNS)))
            self._kept.move_to_end(campaign)
        with kept.lock:
            self._update(kept, campaign, cells)
            rows = kept.rows
        with self._lock:
            while len(self._kept) > 1 and sum(len(one.rows) for one in self._kept.values()) > MOST_ROWS:
                self._kept.popitem(last=False)
        return rows

    def _update(self, kept: _Kept, campaign: int, cells: Sequence[Cell]) -> None:
        places = {tuple(cell): place for place, cell in enumerate(cells)}
        same: dict[Any, Any] = {}  # of words that are in many rows, one is kept
        with self._database.reading() as connection:
            found = connection.execute(_QUERY, {"campaign": campaign, "write": kept.write})
            write, changed = kept.write, []
            for last, number, arm, world, fault, *values in found:
                write = max(write, last)
                kept_once = (same.setdefault(one, one) if type(one) is str else one for one in values)
                changed.append((number, places[arm, world, fault], *kept_once))
        if not changed:
            return
        rows = np.array(changed, COLUMNS)
        if len(kept.rows):
            # A copy: somebody may be reading the old one. Runs are planned once, so none is new.
            rows, new = kept.rows.copy(), rows
            rows[np.searchsorted(rows["id"], new["id"])] = new
        kept.rows, kept.write = rows, write


def of_records(cells: Sequence[Cell], records: Iterable[FlightRecord]) -> Rows:
    """The same of runs that are in no store."""
    places = {cell: place for place, cell in enumerate(cells)}
    return np.array([_of_record(places, record) for record in records], COLUMNS)


def _of_record(places: dict[Cell, int], record: FlightRecord) -> tuple[object, ...]:
    one = record.result
    values = [getattr(one, name, None) for name in _OF_RESULT]
    has_twin = one is not None and one.twin_digest != ""
    as_twin = has_twin and one is not None and one.digest == one.twin_digest
    run = (record.id, places[record.cell], *(getattr(record, name) for name in _OF_RUN))
    return (*run, *values, has_twin, as_twin)


def by_cell(runs: Rows, count: int) -> list[NDArray[np.int64]]:
    """Which of ``runs`` are of each of ``count`` cells, in their order."""
    order = np.argsort(runs["cell"], kind="stable")
    return np.split(order, np.searchsorted(runs["cell"][order], np.arange(1, count)))


def partners(runs: Rows, others: Rows, cell_of: Sequence[int]) -> NDArray[np.int64]:
    """Of each run, where in ``others`` the run of the same number and seed is, or -1.

    ``cell_of[cell]`` is the cell of ``others`` that a cell of ``runs`` is paired with, -1 for none.
    """
    wanted = np.asarray(cell_of, np.int64)[runs["cell"]]
    order = np.lexsort((others["number"], others["cell"]))
    keys = others["cell"][order] << 32 | others["number"][order]
    asked = wanted << 32 | runs["number"]
    found = np.searchsorted(keys, asked)
    found[found == len(keys)] = 0
    if not len(keys):
        return np.full(len(runs), -1)
    at = order[found]
    same = (keys[found] == asked) & (wanted >= 0) & (others["seed"][at] == runs["seed"])
    return np.where(same, at, -1)


_HAS_TWIN = sa.func.coalesce(ResultRow.twin_digest != "", sa.false())
_AS_TWIN = sa.func.coalesce(ResultRow.twin_digest == ResultRow.digest, sa.false())
_QUERY = (
    sa.select(
        *(RunRow.changed, RunRow.id, RunRow.arm, RunRow.world, RunRow.fault),
        *(getattr(RunRow, name) for name in _OF_RUN),
        *(getattr(ResultRow, name) for name in _OF_RESULT),
        *(_HAS_TWIN, _AS_TWIN),
    )
    .join(ResultRow, ResultRow.run_id == RunRow.id, isouter=True)
    .where(RunRow.campaign_id == sa.bindparam("campaign"), RunRow.changed > sa.bindparam("write"))
    .order_by(RunRow.id)
)
