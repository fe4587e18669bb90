"""Estimates from samples that are not uniform, how many flights are needed, and what they can tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded when they are used: half a second

from dashboard.campaigns.statistics.proportions import EVERYTHING, Interval, wilson, z_of

CURRENT_PRACTICE_Z = 1.96
"""Leveugle's table rounds the quantile of 95 %."""


class Estimate(NamedTuple):
    """A proportion, its interval, and the size of the uniform sample that would tell as much."""

    p: float
    interval: Interval
    n_eff: float


class Stratum(NamedTuple):
    """``weight``: the stratum's part of the population."""

    weight: float
    successes: int
    trials: int


def weighted_proportion(outcomes: Sequence[bool], weights: Sequence[float], level: float = 0.95) -> Estimate:
    """Estimate a proportion from weighted outcomes; planned for the studies.

    The estimate is sum(w y) / sum(w), its interval Wilson's on Kish's n_eff = (sum w)^2 / sum(w^2).
    """
    y, w = np.asarray(outcomes, dtype=float), np.asarray(weights, dtype=float)
    if len(y) != len(w) or (w < 0).any() or not np.isfinite(w).all():
        raise ValueError("weights: one for each outcome, none negative or infinite")
    if w.sum() == 0:
        return Estimate(float("nan"), EVERYTHING, 0.0)
    p, n_eff = float(w @ y / w.sum()), float(w.sum() ** 2 / (w @ w))
    return Estimate(p, wilson(p * n_eff, n_eff, level), n_eff)


def stratified_proportion(
    strata: Sequence[Stratum], level: float = 0.95, limits: Callable[[int, int, float], Interval] = wilson
) -> Estimate:
    """Estimate a proportion from strata: p = sum(W_h p_h), with variance sum(W_h^2 p_h (1 - p_h) / n_h).

    The interval adds the squared distances of each stratum's ``limits`` (Newcombe's way; Donner and Zou
    2002): it stays honest where a stratum saw no event, at the price of being a little wide.
    ``n_eff`` is p (1 - p) / variance, infinite if no stratum varies.
    """
    total = sum(stratum.weight for stratum in strata)
    if total <= 0 or any(stratum.trials == 0 or stratum.weight < 0 for stratum in strata):
        raise ValueError("strata: each needs trials and a weight, and the weights a positive sum")
    p = variance = below = above = 0.0
    for weight, successes, trials in strata:
        share, p_h, ends = weight / total, successes / trials, limits(successes, trials, level)
        p += share * p_h
        variance += share**2 * p_h * (1 - p_h) / trials
        below += (share * (p_h - ends.low)) ** 2
        above += (share * (ends.high - p_h)) ** 2
    interval = Interval(max(p - sqrt(below), 0.0), min(p + sqrt(above), 1.0))
    return Estimate(p, interval, p * (1 - p) / variance if variance else float("inf"))


def neyman_allocation(flights: int, weights: Sequence[float], deviations: Sequence[float]) -> list[int]:
    """Allocate ``flights`` to strata in proportion to W_h sigma_h (Neyman).

    Each stratum gets one at least; largest remainders settle the rounding.
    """
    products = np.asarray(weights, dtype=float) * np.asarray(deviations, dtype=float)
    if flights < len(products) or (products < 0).any() or products.sum() == 0:
        raise ValueError("allocation: at least a flight per stratum, and a stratum that varies")
    spare = flights - len(products)
    ideal = products / products.sum() * flights
    # Strata that are due less than one flight get theirs first; the others share what is left.
    above_one = np.maximum(ideal - 1, 0.0)
    extra = above_one * (spare / above_one.sum()) if above_one.sum() else above_one
    counts = np.floor(extra).astype(int)
    for index in np.argsort(counts - extra, kind="stable")[: spare - int(counts.sum())]:
        counts[index] += 1
    return [int(count) + 1 for count in counts]


def sample_size(margin: float, population: float = float("inf"), p: float = 0.5) -> int:
    """Injections needed to know a proportion to +- ``margin`` at 95 %; planned for the studies.

    Leveugle et al. 2009:

    n = N / (1 + e^2 (N - 1) / (t^2 p (1 - p))), rounded as in the published tables.
    """
    infinite = CURRENT_PRACTICE_Z**2 * p * (1 - p) / margin**2
    if population == float("inf"):
        return round(infinite)
    return round(population / (1 + (population - 1) / infinite))


def flights_to_tell(p1: float, p2: float, power: float = 0.8, level: float = 0.95) -> float:
    """Flights an arm that tell p1 from p2 with ``power`` (two independent arms, normal approximation)."""
    mean = (p1 + p2) / 2
    chance = z_of(level) * sqrt(2 * mean * (1 - mean))
    spread = float(scipy.stats.norm.ppf(power)) * sqrt(p1 * (1 - p1) + p2 * (1 - p2))
    return (chance + spread) ** 2 / (p1 - p2) ** 2


def resolvable_drop(flights: int, p: float = 0.95, power: float = 0.8, level: float = 0.95) -> float | None:
    """The smallest drop of a success rate ``p`` that ``flights`` an arm can tell; None if none can."""
    if flights < 1 or flights_to_tell(p, 0.0, power, level) > flights:
        return None
    found = scipy.optimize.brentq(lambda q: flights_to_tell(p, q, power, level) - flights, 0.0, p - 1e-6)
    return p - float(found)
