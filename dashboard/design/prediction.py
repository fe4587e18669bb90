"""How many missions a design is predicted to lose when it is flown, and whether what was flown agrees.

Of an element k in n strikes harmed; then of m more with the same harm probability X harm, a beta-binomial
number: binomial with a probability from Beta(k + 1/2, n - k + 1/2), the posterior of Jeffreys' prior. The
law of all elements together is the convolution of theirs, so intervals are exact for it and nothing is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from dashboard.evidence.ledger import StrikeCounts
from services.models.base import Strict

LEVEL = 0.95
"""Of a prediction interval."""


class PlannedStrikes(NamedTuple):
    """An element's strikes so far, and how many more are to be made."""

    known: StrikeCounts
    more: int


class HarmPrediction(Strict):
    """Of ``strikes`` that are to be made: the part that is expected to harm, and its prediction interval."""

    strikes: int
    share: float
    low: float
    high: float
    level: float


def predict(planned: Sequence[PlannedStrikes], level: float = LEVEL) -> HarmPrediction:
    """The part of the strikes of several elements that harms, with an interval that holds with ``level``.

    It accounts for how few strikes are known and for how few are to be made; that of none is everything.
    """
    strikes = sum(one.more for one in planned)
    if strikes == 0:
        return HarmPrediction(strikes=0, share=0.0, low=0.0, high=1.0, level=level)
    law = harm_law(planned)
    below = np.cumsum(law)
    low = int(np.searchsorted(below, (1 - level) / 2, side="right"))
    high = int(np.searchsorted(below, (1 + level) / 2, side="left"))
    return HarmPrediction(
        strikes=strikes,
        share=float(np.arange(strikes + 1) @ law) / strikes,
        low=low / strikes,
        high=min(high, strikes) / strikes,
        level=level,
    )


def harm_law(planned: Sequence[PlannedStrikes]) -> NDArray[np.float64]:
    """The probabilities (strikes + 1,) that so many of all strikes harm."""
    law = np.ones(1)
    for known, more in planned:
        first, second = known.harmed + 0.5, known.struck - known.harmed + 0.5
        law = np.convolve(law, scipy.stats.betabinom.pmf(np.arange(more + 1), more, first, second))
    return law
