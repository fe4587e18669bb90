"""Odometry: the vehicle's position as it is measured, which may drift from the true one."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from services.models.equipment import Odometry
from services.runtime.rng import generator

Floats = NDArray[np.float64]

_BLOCK = 256


class Drift:
    """A random walk of the measured position, world frame; nothing where none is asked for."""

    def __init__(self, stated: Odometry, seed: int, period_s: float) -> None:
        self._step_m = stated.drift_m_sqrt_s * sqrt(period_s)
        self._seed = seed
        self._steps = 0
        self._draws: Floats = np.empty((0, 3))
        self.offset: Floats = np.zeros(3)

    @property
    def variance_m2(self) -> float:
        """The variance of each coordinate of the offset, over all flights."""
        return self._steps * self._step_m**2

    def advance(self) -> None:
        """Advance the random walk by one period of odometry."""
        if not self._step_m:
            return
        block, place = divmod(self._steps, _BLOCK)
        if place == 0:
            self._draws = generator(self._seed, "odometry drift", block).standard_normal((_BLOCK, 3))
        self.offset = self.offset + self._draws[place] * self._step_m
        self._steps += 1
