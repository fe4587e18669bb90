"""What a protection costs flights without a fault: time, energy, checks, and missions that it loses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np
import scipy

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.statistics.proportions import clopper_pearson
from deploy.errors import BadSpecError
from services.models.base import Strict


class RelativeOverhead(Strict):
    """By which part of the bare flight's a quantity grows: the mean, and the ends of its 95 % interval.

    Without ends the interval is not known: there are fewer than two flights, or a model says the mean.
    """

    mean: float
    low: float | None = None
    high: float | None = None


class ProtectionCost(Strict):
    """A protection beside the bare arm, over ``pairs`` golden flights of one world and seed.

    ``arrived`` are those that arrive bare; of them ``lost`` do not with the protection, and ``lost_high`` is
    the upper end of that part's 95 % interval. Overheads are over those that arrive in both.
    """

    pairs: int
    arrived: int
    lost: int
    lost_high: float
    flight_time: RelativeOverhead
    energy: RelativeOverhead


class GoldenFlight(NamedTuple):
    """A flight without a fault: whether it arrived, its time in s and its energy in kJ."""

    arrived: bool
    flight_time_s: float
    energy_kj: float


Goldens = Mapping[tuple[str, int], GoldenFlight]
"""Golden flights by world and seed."""


def golden_flights(runs: Iterable[FlightRecord]) -> Goldens:
    """The golden flights behind runs of one mission: twins of those with a fault, and those without one."""
    found = {}
    for run in runs:
        flight = _golden(run.result) if run.result is not None else None
        if flight is not None:
            found[run.cell.world, run.seed] = flight
    return found


def _golden(result: Result) -> GoldenFlight | None:
    twin = (result.twin_success, result.twin_flight_time_s, result.twin_energy_kj)
    if twin[0] is not None and twin[1] is not None and twin[2] is not None:
        return GoldenFlight(bool(twin[0]), twin[1], twin[2])
    if not result.injection:
        return GoldenFlight(result.success, result.flight_time_s, result.energy_kj)
    return None


def cost(name: str, bare: Goldens, protected: Goldens) -> ProtectionCost:
    """What the protection of that name costs.

    :raises BadSpecError: if no golden flight arrives bare and with it: nothing is known then.
    """
    both = [(flight, protected[place]) for place, flight in bare.items() if place in protected]
    arrived = [pair for pair in both if pair[0].arrived]
    kept = [pair for pair in arrived if pair[1].arrived]
    if not kept:
        message = (
            f"arm {name!r}: no golden flight arrives with and without it, of {len(both)} on the same seeds"
        )
        raise BadSpecError(message)
    lost = len(arrived) - len(kept)
    return ProtectionCost(
        pairs=len(both),
        arrived=len(arrived),
        lost=lost,
        lost_high=clopper_pearson(lost, len(arrived)).high,
        flight_time=mean_overhead([own.flight_time_s / alone.flight_time_s - 1 for alone, own in kept]),
        energy=mean_overhead([own.energy_kj / alone.energy_kj - 1 for alone, own in kept]),
    )


def mean_overhead(parts: Sequence[float]) -> RelativeOverhead:
    """The mean of relative differences (n,) with Student's interval of 95 %."""
    mean = float(np.mean(parts))
    if len(parts) < 2:
        return RelativeOverhead(mean=mean)
    half = float(scipy.stats.t.ppf(0.975, len(parts) - 1)) * float(np.std(parts, ddof=1)) / sqrt(len(parts))
    return RelativeOverhead(mean=mean, low=mean - half, high=mean + half)


def added(measured: Sequence[RelativeOverhead], modelled: Sequence[RelativeOverhead]) -> RelativeOverhead:
    """The sum of overheads; its interval by the squares of both sides, as of independent ones.

    What a model says counts as exact. Without the ends of any that is measured the sum has none.
    """
    mean = sum(one.mean for one in (*measured, *modelled))
    ends = [(one.mean, one.low, one.high) for one in measured]
    below = [middle - low for middle, low, _ in ends if low is not None]
    above = [high - middle for middle, _, high in ends if high is not None]
    if min(len(below), len(above)) < len(ends):
        return RelativeOverhead(mean=mean)
    return RelativeOverhead(mean=mean, low=mean - hypot(*below), high=mean + hypot(*above))
