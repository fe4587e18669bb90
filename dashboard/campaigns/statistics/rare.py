"""The rate of a rare event, from draws that go where the event was seen, without bias.

Strata of known weight are drawn from in batches. The first, the pilot, draws as their weights say; each later
one where events are expected after the batches before. The last batch alone makes the estimate: what it draws
from depends on earlier batches only, so it is an ordinary stratified sample, unbiased, with an interval that
holds whatever was learned. The batches before are counted as cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded when they are used: half a second

from dashboard.campaigns.statistics.harm_rates import Counts, Floats, expected_rates, grouped
from dashboard.campaigns.statistics.proportions import Interval, mid_p, wilson
from dashboard.campaigns.statistics.sampling import Stratum, neyman_allocation, stratified_proportion
from services.runtime import rng

LEARNING = (0.08, 0.06, 0.06)
"""Parts of the draws that pilot and learning batches have; the rest makes the estimate."""

DEFENSIVE = 0.1
"""The part of each learned batch that is drawn by the weights: no draw weighs over ten uniform ones."""

GROUPS = 3
"""In so many groups of like strata the last batch is drawn: each has draws enough for an interval."""

FEWEST = 40
"""Draws of an estimate at least."""

UNSEEN = 0.5
"""Events that a group may have had beyond those seen: where nothing was found yet, draws still go."""

MOST_N_EFF = 1e12

Strike = Callable[[Counts], Counts]
"""Draws so many times from each stratum: of how many draws of each the event came."""


class RareEstimate(NamedTuple):
    """A rate with its interval, and what it cost.

    ``n_eff`` is the number of uniform draws whose Wilson interval is as wide, ``draws`` is that of all draws
    made, and ``groups`` are those of the last batch: weight, events and draws of each.
    """

    p: float
    interval: Interval
    n_eff: float
    draws: int
    groups: tuple[Stratum, ...]

    @property
    def gain(self) -> float:
        """How many uniform draws one draw was worth."""
        return self.n_eff / self.draws


def estimate_rare(
    names: Sequence[Sequence[str]],
    weights: Sequence[float],
    strike: Strike,
    draws: int,
    seed: int,
    level: float = 0.95,
) -> RareEstimate:
    """Estimate the rate of a rare event in a population of strata by ``draws`` draws.

    ``names`` say what each of n strata is (:func:`dashboard.campaigns.statistics.harm_rates.expected_rates`),
    ``weights`` (n,) which part of the population it is; ``strike`` is asked once a batch. The same seed draws
    the same.

    :raises ValueError: if there are no strata, weights do not fit them, draws are too few or strata too many.
    """
    shares = np.asarray(weights, dtype=float)
    if not len(names) or len(names) != len(shares) or not (shares > 0).all() or not np.isfinite(shares).all():
        raise ValueError("strata: each needs names and a weight above 0")
    if draws < FEWEST:
        message = f"draws: {draws}, a rare event needs {FEWEST} at least"
        raise ValueError(message)
    shares = shares / shares.sum()
    drawn, events = np.zeros(len(shares), np.int64), np.zeros(len(shares), np.int64)
    *sizes, last = _sizes(draws)
    for batch, size in enumerate(sizes):
        proposal = shares if batch == 0 else learned_proposal(shares, expected_rates(names, drawn, events))
        asked = rng.generator(seed, "rare", batch).multinomial(size, proposal)
        events += strike(asked)
        drawn += asked
    groups = _last_batch(shares, expected_rates(names, drawn, events), drawn, last, strike, seed)
    estimate = stratified_proportion(groups, level, mid_p)
    n_eff = _as_wide(estimate.p, estimate.interval.width, level)
    return RareEstimate(estimate.p, estimate.interval, n_eff, draws, tuple(groups))


def learned_proposal(weights: Floats, rates: Floats) -> Floats:
    """Where to draw (n,): in proportion to W sigma as expected, and for a part by the weights alone."""
    errors = weights * np.sqrt(rates * (1.0 - rates))
    return np.asarray((1.0 - DEFENSIVE) * errors / errors.sum() + DEFENSIVE * weights)


def _sizes(draws: int) -> list[int]:
    ends = np.rint(np.cumsum((0.0, *LEARNING, 1.0 - sum(LEARNING))) * draws).astype(int)
    return [int(end - begin) for begin, end in pairwise(ends)]


def _last_batch(
    weights: Floats, rates: Floats, drawn: Counts, size: int, strike: Strike, seed: int
) -> list[Stratum]:
    """Draw ``size`` from groups of like strata, in each by the weights; weight, events, draws of each."""
    group_of = grouped(weights, rates, GROUPS)
    groups = np.unique(group_of)
    members = [np.flatnonzero(group_of == group) for group in groups]
    weight = np.array([weights[one].sum() for one in members])
    seen = np.array([drawn[one].sum() for one in members])
    expected = np.array([weights[one] @ rates[one] for one in members]) / weight
    doubtful = np.minimum(expected + UNSEEN / np.maximum(seen, 1), 0.5)
    counts = neyman_allocation(size, list(learned_proposal(weight, doubtful)), [1.0] * len(groups))
    asked = np.zeros(len(weights), np.int64)
    for group, one, count in zip(groups, members, counts, strict=True):
        draw = rng.generator(seed, "rare group", int(group))
        asked[one] = draw.multinomial(count, weights[one] / weights[one].sum())
    events = strike(asked)
    return [
        Stratum(float(of), int(events[one].sum()), count)
        for of, one, count in zip(weight, members, counts, strict=True)
    ]


def _as_wide(p: float, width: float, level: float) -> float:
    """How many uniform draws have a Wilson interval of that width around ``p``."""

    def wider(log_n: float) -> float:
        n = float(np.exp(log_n))
        return wilson(p * n, n, level).width - width

    lowest, highest = float(np.log(1e-3)), float(np.log(MOST_N_EFF))
    if wider(lowest) <= 0.0 or wider(highest) >= 0.0:
        return 0.0 if wider(lowest) <= 0.0 else MOST_N_EFF
    return float(np.exp(scipy.optimize.brentq(wider, lowest, highest)))
