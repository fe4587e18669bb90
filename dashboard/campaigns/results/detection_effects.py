"""What a detector made of a fault that was injected: the one definition of four words.

*unaffected*: every message of the flight is its golden twin's, and there was no alarm. *missed*: messages
differ and no alarm came after the fault. *caught*: an alarm did. *recovered*: caught, an output was made
again or replaced, and the flight is nearer its twin (by :func:`_deviation`) than the same fault's flight
without a detector.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.spec import Cell
from dashboard.campaigns.store.columns import Rows, of_records, partners

Effect = Literal["unaffected", "missed", "caught", "recovered"]
EFFECTS: tuple[Effect, ...] = get_args(Effect)

NO_EFFECT = -1
"""Without a detector, an injected fault or a golden twin."""

_ALONE = Cell("", "", "")


def effects(cells: Sequence[Cell], runs: Rows, unprotected: Mapping[str, str]) -> NDArray[np.int64]:
    """Which of :data:`EFFECTS` the detector had in each run, or :data:`NO_EFFECT`.

    ``unprotected`` is each arm's arm without a detector: its run of the same number has the same fault.
    Where there is none, none is recovered.
    """
    places = {cell: place for place, cell in enumerate(cells)}
    bare = [places.get(cell._replace(arm=unprotected.get(cell.arm, "")), -1) for cell in cells]
    beside = partners(runs, runs, bare)
    found = _effects(runs)
    paired = np.flatnonzero((found == EFFECTS.index("caught")) & (beside >= 0))
    found[paired] = _effects(runs[paired], runs[beside[paired]])
    return found


def effect(flight: Result, unprotected: Result | None = None) -> Effect | None:
    """What the detector made of the fault; None without a detector, an injected fault or a golden twin.

    ``unprotected`` is the same fault's flight without a detector. Where there is none, none is recovered.
    """
    found = _effects(_alone(flight), _alone(unprotected) if unprotected is not None else None)[0]
    return EFFECTS[found] if found != NO_EFFECT else None


def _alone(flight: Result) -> Rows:
    return of_records([_ALONE], [FlightRecord(_ALONE, 0, 0, "done", 1, "", flight, 0)])


def _effects(flights: Rows, beside: Rows | None = None) -> NDArray[np.int64]:
    """The definition; ``beside`` has the flight without a detector of each."""
    unaffected, missed, caught, recovered = range(len(EFFECTS))
    silent = np.where(flights["as_twin"], unaffected, missed)
    found = np.where(flights["alarms"] == 0, silent, caught)
    if beside is not None:
        nearer = (beside["injection"] == "injected") & (_deviation(flights) < _deviation(beside))
        found[(found == caught) & (flights["recomputed"] > 0) & nearer] = recovered
    known = ~np.isnan(flights["alarms"]) & (flights["injection"] == "injected") & flights["has_twin"]
    return np.where(known, found, NO_EFFECT)


def _deviation(flights: Rows) -> NDArray[np.float64]:
    """How far a flight's quality is from its golden twin's: the largest part by which one measure differs.

    Measures are flight time, distance and energy. Infinite if the mission ended another way than the twin's.
    """
    parts = []
    for measure in ("flight_time_s", "distance_m", "energy_kj"):
        own, twin = flights[measure], flights[f"twin_{measure}"]
        parts.append(np.abs(own - twin) / np.where(twin == 0, 1.0, twin))
    return np.where(flights["result"] == flights["twin_result"], np.max(parts, axis=0), np.inf)
