"""Moving air: a steady wind and gusts, each axis an Ornstein-Uhlenbeck process.

The exponential correlation is that of the Dryden model's longitudinal gusts (MIL-F-8785C) at a fixed
speed through the air; the vehicle is a point in it.
"""

from __future__ import annotations

from math import exp, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.models.equipment import Wind
from services.runtime.rng import generator

Floats = NDArray[np.float64]

_BLOCK = 512


class Air:
    """The air's velocity around the vehicle, world frame, physics step by physics step."""

    def __init__(self, wind: Wind, seed: int, period_s: float) -> None:
        self._mean = np.array(wind.mean_m_s)
        self._deviation = np.array(wind.gust_m_s)
        self._kept = exp(-period_s / wind.correlation_s)
        self._seed = seed
        self._block = -1
        self._velocity: Floats = np.empty((0, 3))
        # Gusts blow before the flight begins: their first value has the full deviation.
        self._gust: Floats = generator(seed, "gust at the start").standard_normal(3) * self._deviation

    def velocity(self, first_step: int, n_steps: int) -> Floats:
        """The velocity (n_steps, 3) in m/s; to be asked for in the order of the steps."""
        parts = []
        while n_steps:
            block, place = divmod(first_step, _BLOCK)
            if block != self._block:
                self._next(block)
            parts.append(self._velocity[place : place + n_steps])
            first_step += len(parts[-1])
            n_steps -= len(parts[-1])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _next(self, block: int) -> None:
        drawn = generator(self._seed, "gusts", block).standard_normal((_BLOCK, 3))
        gusts = correlate(self._gust, drawn * self._deviation, self._kept)
        self._gust = gusts[-1].copy()
        self._velocity = self._mean + gusts
        self._block = block


@njit(cache=True)
def correlate(before: Floats, drawn: Floats, kept: float) -> Floats:
    """First-order process (n, 3) that follows ``before`` (3,), of which ``kept`` stays in a step.

    ``drawn`` (n, 3) are independent draws with the deviation that the process has.
    """
    fresh = sqrt(1.0 - kept * kept)
    process = np.empty_like(drawn)
    for axis in range(3):
        value = before[axis]
        for step in range(len(drawn)):
            value = kept * value + fresh * drawn[step, axis]
            process[step, axis] = value
    return process
