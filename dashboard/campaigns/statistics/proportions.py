"""Intervals of proportions, of their differences and of medians, exact McNemar, Holm.

Coverage of the 95 % intervals, by simulation, is held by the tests: 94 to 97 % averaged over p.
Clopper-Pearson is conservative by construction: at least 95 % at every p.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded when they are used: half a second
from numpy.typing import ArrayLike, NDArray


class Interval(NamedTuple):
    """Both ends of a confidence interval."""

    low: float
    high: float

    @property
    def width(self) -> float:
        """The distance between both ends."""
        return self.high - self.low


class Pairs(NamedTuple):
    """Two configurations on the same seeds: how many pairs succeeded in both, in one only, in neither."""

    both: int
    first_only: int
    second_only: int
    neither: int

    @classmethod
    def of(cls, first: ArrayLike, second: ArrayLike) -> Pairs:
        """Count the outcomes of pairs, given in the same order."""
        one, other = np.asarray(first, bool), np.asarray(second, bool)
        if one.shape != other.shape:
            message = f"{len(one)} outcomes beside {len(other)}"
            raise ValueError(message)
        both, neither = int(np.count_nonzero(one & other)), int(np.count_nonzero(~one & ~other))
        return cls(both, int(one.sum()) - both, int(other.sum()) - both, neither)


EVERYTHING = Interval(0.0, 1.0)
"""What is known of a proportion without trials."""


def z_of(level: float) -> float:
    """The two-sided standard normal quantile of a confidence level."""
    return float(scipy.stats.norm.ppf((1 + level) / 2))


def wilson(successes: float, trials: float, level: float = 0.95) -> Interval:
    """Wilson's score interval of a proportion. Effective sample sizes need not be whole numbers.

    Zero events in n end near 3/n above. Everything is possible without trials.
    """
    if trials == 0:
        return EVERYTHING
    p, z2 = successes / trials, z_of(level) ** 2
    middle = (p + z2 / (2 * trials)) / (1 + z2 / trials)
    half = sqrt(z2 * (p * (1 - p) + z2 / (4 * trials)) / trials) / (1 + z2 / trials)
    # Rounding must not exclude the estimate at the ends of the range.
    return Interval(min(max(middle - half, 0.0), p), max(min(middle + half, 1.0), p))


def clopper_pearson(successes: int, trials: int, level: float = 0.95) -> Interval:
    """The exact (Clopper-Pearson) interval of a proportion, for a claim; planned for the studies.

    It covers at least ``level`` whatever p is.
    """
    if trials == 0:
        return EVERYTHING
    interval = scipy.stats.binomtest(successes, trials).proportion_ci(level, method="exact")
    return Interval(float(interval.low), float(interval.high))


def mid_p(successes: int, trials: int, level: float = 0.95) -> Interval:
    """The mid-P interval of a proportion: Clopper-Pearson's with half the chance of what was seen.

    With few events it covers close to ``level``, where Wilson's lower end is too high (Agresti and Gottard
    2005, Comput. Stat. Data Anal. 51:6447).
    """
    if trials == 0:
        return EVERYTHING
    p, tail = successes / trials, (1 - level) / 2

    def beyond(rate: float, part: float) -> float:
        fewer = scipy.special.bdtr(successes - 1, trials, rate) if successes else 0.0
        return float(fewer + scipy.special.bdtr(successes, trials, rate)) / 2 - part

    low = scipy.optimize.brentq(beyond, 0.0, p, args=(1 - tail,)) if successes else 0.0
    high = scipy.optimize.brentq(beyond, p, 1.0, args=(tail,)) if successes < trials else 1.0
    return Interval(float(low), float(high))


def lower_bound(found: int, of: int, level: float) -> float:
    """The one-sided Clopper-Pearson bound of a proportion: above it with confidence ``level``."""
    return clopper_pearson(found, of, 2 * level - 1).low


def median_interval(values: Sequence[float] | NDArray[np.float64], level: float = 0.95) -> Interval | None:
    """The interval of a median of ``values`` (n,), in their unit; of any continuous distribution.

    As many values lie below a median as heads fall (David and Nagaraja, Order Statistics, 7.1). Intervals
    between two of the values cover a little more or less than ``level``: it lies between the next two, as far
    from either as Hettmansperger and Sheather say (1986, Stat. Probab. Lett. 4:75). None where no two values
    cover it: at 95 %, with fewer than six.
    """
    n = len(values)
    outer = int(scipy.stats.binom.ppf((1 - level) / 2, n, 0.5)) if n else 0
    if outer == 0:
        return None
    more, less = (1 - 2 * float(scipy.stats.binom.cdf(below, n, 0.5)) for below in (outer - 1, outer))
    beyond = (more - level) / (more - less)
    inwards = (n - outer) * beyond / (outer + (n - 2 * outer) * beyond)
    ordered = np.sort(values)
    low, high = float(ordered[outer - 1]), float(ordered[-outer])
    return Interval(
        low + inwards * (float(ordered[outer]) - low), high + inwards * (float(ordered[-outer - 1]) - high)
    )


def newcombe(successes: tuple[int, int], trials: tuple[int, int], level: float = 0.95) -> Interval:
    """Interval of p1 - p2 of independent samples; planned for the studies.

    Newcombe 1998, Stat. Med. 17:873, method 10.
    """
    if 0 in trials:
        return Interval(-1.0, 1.0)
    first, second = (wilson(x, n, level) for x, n in zip(successes, trials, strict=True))
    return _squared_and_added(successes[0] / trials[0], first, successes[1] / trials[1], second, 0.0)


def newcombe_paired(pairs: Pairs, level: float = 0.95) -> Interval:
    """Interval of p1 - p2 of paired samples (Newcombe 1998, Stat. Med. 17:2635, method 10)."""
    n = sum(pairs)
    if n == 0:
        return Interval(-1.0, 1.0)
    ones, twos = pairs.both + pairs.first_only, pairs.both + pairs.second_only
    spread = ones * (n - ones) * twos * (n - twos)
    agreement = float(pairs.both * pairs.neither - pairs.first_only * pairs.second_only)
    if agreement > 0:
        agreement = max(agreement - n / 2, 0.0)
    phi = agreement / sqrt(spread) if spread else 0.0
    return _squared_and_added(ones / n, wilson(ones, n, level), twos / n, wilson(twos, n, level), phi)


def _squared_and_added(p1: float, one: Interval, p2: float, two: Interval, phi: float) -> Interval:
    """Interval of p1 - p2 from the intervals of both and their correlation."""

    def distance(a: float, b: float) -> float:
        return sqrt(max(a * a - 2 * phi * a * b + b * b, 0.0))

    low = distance(p1 - one.low, two.high - p2)
    high = distance(one.high - p1, p2 - two.low)
    return Interval(p1 - p2 - low, p1 - p2 + high)


def mcnemar(pairs: Pairs) -> float:
    """Two-sided p-value of the exact test that both configurations succeed alike."""
    discordant = pairs.first_only + pairs.second_only
    return float(scipy.stats.binomtest(pairs.first_only, discordant).pvalue) if discordant else 1.0


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values adjusted for their number (Holm 1979), in the order given."""
    values = np.asarray(p_values, dtype=float)
    order = np.argsort(values, kind="stable")
    adjusted = np.empty_like(values)
    steps = values[order] * np.arange(len(values), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(value) for value in adjusted]
