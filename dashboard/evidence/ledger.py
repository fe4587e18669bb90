"""The ledger of a claim: from upsets of elements to failures in a flight hour, each factor with its interval.

The rate of an element is

    FIT * 1e-9 * flux * share of time * P(manifests) * P(harm | manifests),

and that of the system their sum. The one-sided bound is by Monte Carlo. A stated factor is lognormal, its
range that of 95 %. A probability of which k in n were counted is drawn from Beta(k + 1, n - k), the law whose
quantiles are the upper bounds of Clopper and Pearson; the product of the two of a line then has exactly the
law of their quotient, harm in strikes, since Beta(a, b) * Beta(a + b, c) = Beta(a, b + c).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dashboard.campaigns.statistics.proportions import Interval, clopper_pearson
from dashboard.evidence.budget import Element, Stated, UpsetBudget

HOURS = 1e9
"""In which a FIT is one failure."""

_RANGE = 2 * 1.959963984540054
"""Standard deviations between the ends of a 95 % range."""

_ENOUGH = 1e9
"""Times the strikes that were made: who needs more gets no answer."""


class StrikeCounts(NamedTuple):
    """Of the strikes of a cell: how many were made, changed anything, and harmed the mission."""

    struck: int
    manifested: int
    harmed: int


@dataclass(frozen=True, slots=True)
class LedgerLine:
    """An element: its counts, the intervals of both probabilities, its rate and that rate's bound, 1/h."""

    element: Element
    counts: StrikeCounts
    manifests: Interval
    harms: Interval
    rate_per_hour: float
    bound_per_hour: float


@dataclass(frozen=True, slots=True)
class Ledger:
    """All lines, the sum of their rates and its bound, 1/h.

    ``more_strikes``: without further harm, how many more strikes of the same mixture the bound needs to meet
    the budget's target; 0 if it does, None without a target.
    """

    lines: tuple[LedgerLine, ...]
    rate_per_hour: float
    bound_per_hour: float
    more_strikes: int | None


def reckon(budget: UpsetBudget, counts: Sequence[StrikeCounts], seed: int = 0) -> Ledger:
    """The ledger of a budget; ``counts`` are those of its elements, in their order."""
    drawn = _drawn(budget, counts, seed)
    lines = tuple(
        LedgerLine(
            element=element,
            counts=one,
            manifests=clopper_pearson(one.manifested, one.struck),
            harms=clopper_pearson(one.harmed, one.manifested),
            rate_per_hour=upsets_per_hour(element) * one.harmed / max(one.struck, 1),
            bound_per_hour=float(np.quantile(rates, budget.confidence)),
        )
        for element, one, rates in zip(budget.elements, counts, drawn, strict=True)
    )
    bound = float(np.quantile(drawn.sum(axis=0), budget.confidence))
    return Ledger(
        lines=lines,
        rate_per_hour=sum(line.rate_per_hour for line in lines),
        bound_per_hour=bound,
        more_strikes=_more_strikes(budget, counts, seed, bound),
    )


def upsets_per_hour(element: Element) -> float:
    """The upsets of an element that meet what its cell's faults strike, 1/h, by the stated values."""
    return element.fit.value / HOURS * element.flux.value * element.share.value


def _drawn(budget: UpsetBudget, counts: Sequence[StrikeCounts], seed: int) -> NDArray[np.float64]:
    """Draws (elements, draws) of rates, 1/h. Each line draws by itself: one more moves no other."""
    return np.array([drawn_line(budget, number, one, seed) for number, one in enumerate(counts)])


def drawn_line(budget: UpsetBudget, number: int, one: StrikeCounts, seed: int = 0) -> NDArray[np.float64]:
    """Draws (draws,) of the rate of the element of that number, 1/h.

    The draws of what is stated are the same for all counts, so that rates may be compared draw by draw.
    """
    element = budget.elements[number]
    generator = np.random.default_rng([seed, number])
    rates = np.full(budget.draws, 1.0 / HOURS)
    for factor in (element.fit, element.flux, element.share):
        rates *= _stated(factor, budget.draws, generator)
    rates *= _counted(one.manifested, one.struck, budget.draws, generator)
    rates *= _counted(one.harmed, one.manifested, budget.draws, generator)
    return rates


def _stated(factor: Stated, draws: int, generator: np.random.Generator) -> NDArray[np.float64]:
    if factor.low is None or factor.high is None:
        return np.full(draws, factor.value)
    deviation = np.log(factor.high / factor.low) / _RANGE
    drawn: NDArray[np.float64] = factor.value * np.exp(deviation * generator.standard_normal(draws))
    return drawn


def _counted(found: int, of: int, draws: int, generator: np.random.Generator) -> NDArray[np.float64]:
    if found == of:  # also nothing of nothing: everything is possible
        return np.ones(draws)
    return generator.beta(found + 1, of - found, draws)


def _more_strikes(budget: UpsetBudget, counts: Sequence[StrikeCounts], seed: int, bound: float) -> int | None:
    """By bisection over how many times the benign strikes are made again."""
    target = budget.target_per_hour
    if target is None:
        return None
    struck = sum(max(one.struck, 1) for one in counts)

    def met(times: float) -> bool:
        more = [one._replace(struck=one.struck + round(times * max(one.struck, 1))) for one in counts]
        return float(np.quantile(_drawn(budget, more, seed).sum(axis=0), budget.confidence)) <= target

    if bound <= target:
        return 0
    low, high = 0.0, 1.0
    while not met(high):
        low, high = high, 2 * high
        if high > _ENOUGH:
            return None
    while high - low > 0.01 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if met(middle) else (middle, high)
    return round(high * struck)
