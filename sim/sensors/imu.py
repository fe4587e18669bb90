"""The inertial measurement unit: body rates and specific force at its own rate, with bias and noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.models.equipment import Imu
from services.runtime.rng import generator
from sim.vehicle.airframe import GRAVITY_M_S2

Floats = NDArray[np.float64]

_BLOCK = 256


class ImuSamples(NamedTuple):
    """Samples of one stretch of flight, body frame.

    ``time_ns`` (n,), ``rates`` (n, 3) in rad/s, ``force`` (n, 3) in m/s^2: what an accelerometer reads.
    """

    time_ns: NDArray[np.int64]
    rates: Floats
    force: Floats


class InertialUnit:
    """Samples a flight's track at its own rate, 190 Hz by default, whatever the physics step.

    A sample is taken at the first physics step at or after its time and stamped with that step's; the
    mean gap between samples is exact. The bias is drawn once a flight, from the deviations stated.
    """

    def __init__(self, stated: Imu, seed: int) -> None:
        self._period_s = 1.0 / stated.rate_hz
        self._seed = seed
        self._taken = 0
        self._block = -1
        self._noise: Floats = np.empty((0, 6))
        self._deviation = np.repeat([stated.gyro_noise_rad_s, stated.accel_noise_m_s2], 3)
        bias_deviation = np.repeat([stated.gyro_bias_rad_s, stated.accel_bias_m_s2], 3)
        self._bias: Floats = generator(seed, "IMU bias").standard_normal(6) * bias_deviation

    def sample(self, track: Floats) -> ImuSamples:
        """The samples that fall on the steps of ``track``, as :meth:`Vehicle.advance` returns it."""
        rows = due(track, self._taken, self._period_s)
        true = felt(track, rows)
        samples = true + self._bias
        for index in range(len(rows)):
            block, place = divmod(self._taken, _BLOCK)
            if block != self._block:
                drawn = generator(self._seed, "IMU noise", block).standard_normal((_BLOCK, 6))
                self._noise, self._block = drawn * self._deviation, block
            samples[index] += self._noise[place]
            self._taken += 1
        return ImuSamples(np.rint(track[rows, 0] * 1e9).astype(np.int64), samples[:, :3], samples[:, 3:])


@njit(cache=True)
def due(track: Floats, taken: int, period_s: float) -> NDArray[np.int64]:
    """Rows of ``track`` but the first on which a sample falls, ``taken`` having been taken before."""
    rows = np.empty(len(track), dtype=np.int64)
    count = 0
    for row in range(1, len(track)):
        # Half a nanosecond for the rounding of times.
        if track[row, 0] + 5e-10 >= (taken + count + 1) * period_s:
            rows[count] = row
            count += 1
    return rows[:count]


@njit(cache=True)
def felt(track: Floats, rows: NDArray[np.int64]) -> Floats:
    """Body rates and specific force (n, 6) at these rows, the force as the mean over the step before."""
    samples = np.empty((len(rows), 6))
    for index, row in enumerate(rows):
        before, here = track[row - 1], track[row]
        duration = here[0] - before[0]
        x = (here[4] - before[4]) / duration
        y = (here[5] - before[5]) / duration
        z = (here[6] - before[6]) / duration + GRAVITY_M_S2
        qw, qx, qy, qz = here[10], here[11], here[12], here[13]
        samples[index, :3] = here[7:10]
        samples[index, 3] = (
            (1 - 2 * (qy * qy + qz * qz)) * x + 2 * (qx * qy + qw * qz) * y + 2 * (qx * qz - qw * qy) * z
        )
        samples[index, 4] = (
            2 * (qx * qy - qw * qz) * x + (1 - 2 * (qx * qx + qz * qz)) * y + 2 * (qy * qz + qw * qx) * z
        )
        samples[index, 5] = (
            2 * (qx * qz + qw * qy) * x + 2 * (qy * qz - qw * qx) * y + (1 - 2 * (qx * qx + qy * qy)) * z
        )
    return samples
