"""What a detector made of a fault that was injected: the one definition of four words.

*unaffected*: every message of the flight is its golden twin's, and there was no alarm. *missed*: messages
differ and no alarm came after the fault. *caught*: an alarm did. *recovered*: caught, an output was made
again, and the flight is nearer its twin (:func:`deviation`) than the same fault's flight without a detector.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Literal, get_args

from dashboard.campaigns.flight_record import FlightRecord, Result

Effect = Literal["unaffected", "missed", "caught", "recovered"]
EFFECTS: tuple[Effect, ...] = get_args(Effect)


def effect(flight: Result, unprotected: Result | None = None) -> Effect | None:
    """What the detector made of the fault; None without a detector, an injected fault or a golden twin.

    ``unprotected`` is the same fault's flight without a detector. Where there is none, none is recovered.
    """
    if flight.alarms is None or flight.injection != "injected" or not flight.twin_digest:
        return None
    if not flight.alarms:
        return "unaffected" if flight.digest == flight.twin_digest else "missed"
    if not flight.recomputed or unprotected is None or unprotected.injection != "injected":
        return "caught"
    return "recovered" if deviation(flight) < deviation(unprotected) else "caught"


def deviation(flight: Result) -> float:
    """How far a flight's quality is from its golden twin's: the largest part by which one measure differs.

    Measures are flight time, distance and energy. Infinite if the mission ended another way than the twin's.
    """
    if flight.result != flight.twin_result:
        return math.inf
    pairs = (
        (flight.flight_time_s, flight.twin_flight_time_s),
        (flight.distance_m, flight.twin_distance_m),
        (flight.energy_kj, flight.twin_energy_kj),
    )
    return max(abs(own - twin) / twin if twin else abs(own) for own, twin in pairs)


def effects(
    records: Iterable[FlightRecord], unprotected: Mapping[str, str]
) -> Iterable[tuple[FlightRecord, Effect]]:
    """The flights that have an effect, each with it; ``unprotected`` is each arm's arm without a detector."""
    found = list(records)
    flown = {(one.cell, one.number): one.result for one in found}
    for one in found:
        if one.result is None:
            continue
        beside = unprotected.get(one.cell.arm)
        other = None if beside is None else flown.get((one.cell._replace(arm=beside), one.number))
        word = effect(one.result, other)
        if word is not None:
            yield one, word
