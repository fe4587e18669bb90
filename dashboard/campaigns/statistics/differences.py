"""Paired differences of a quantity (flight time, energy) to the golden twin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy  # its parts are loaded when they are used: half a second

from dashboard.campaigns.statistics.proportions import Interval
from services.runtime import rng

RESAMPLES = 2000


def quantile_interval(
    differences: Sequence[float], quantile: float, seed: int, level: float = 0.95, resamples: int = RESAMPLES
) -> Interval | None:
    """Percentile bootstrap interval of a quantile of ``differences`` (n,), in their unit.

    None with fewer than two differences. The same data and seed give the same interval. A quantile
    far out needs many flights: of the 95th percentile, the interval covers its level from n = 200 on, and
    less below, since the sample holds too few flights beyond it. Quantiles are of the Weibull form,
    which is the least biased inwards in the tail.
    """
    if len(differences) < 2:
        return None
    sample = np.asarray(differences, dtype=float)

    def statistic(values: np.ndarray, axis: int) -> np.ndarray:
        return np.asarray(np.quantile(values, quantile, axis=axis, method="weibull"))

    found = scipy.stats.bootstrap(
        (sample,),
        statistic,
        confidence_level=level,
        n_resamples=resamples,
        method="percentile",
        rng=rng.generator(seed, f"bootstrap quantile {quantile}"),
    ).confidence_interval
    return Interval(float(found.low), float(found.high))
