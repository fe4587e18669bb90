"""Minimum-snap spline through waypoints.

Among all curves through given points at given times, with position, velocity, acceleration and jerk
given at both ends, the integral of the squared snap is least for the piecewise polynomial of degree
seven whose derivatives up to the sixth are continuous (Euler-Lagrange: the eighth derivative vanishes;
Mellinger and Kumar 2011). That is one linear system of eight equations a segment.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

_ORDER = 8  # coefficients of a segment
_BAND = 11  # farthest from the diagonal that an equation reaches


@njit(cache=True)
def minimum_snap(
    waypoints: NDArray[np.float64],
    durations: NDArray[np.float64],
    velocity: NDArray[np.float64],
    acceleration: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Coefficients (n, 8, 3) of the n segments between ``waypoints`` (n + 1, 3), m.

    Segment i takes ``durations[i]`` s; its polynomial runs in s = t / durations[i], lowest power first.
    Starts with ``velocity`` and ``acceleration`` (3,) and no jerk, ends at rest.
    """
    segments = len(durations)
    size = _ORDER * segments
    matrix = np.zeros((size, size))
    right = np.zeros((size, 3))
    at_start = _derivatives(0.0)
    at_end = _derivatives(1.0)
    right[0] = waypoints[0]
    right[1] = velocity * durations[0]
    right[2] = acceleration * durations[0] ** 2
    matrix[:4, :_ORDER] = at_start[:4]
    for joint in range(1, segments):
        row, column = _ORDER * joint - 4, _ORDER * joint
        ratio = durations[joint - 1] / durations[joint]
        matrix[row, column - _ORDER : column] = at_end[0]
        right[row] = waypoints[joint]
        for order in range(1, 7):
            matrix[row + order, column - _ORDER : column] = at_end[order]
            matrix[row + order, column : column + _ORDER] = -at_start[order] * ratio**order
        matrix[row + 7, column : column + _ORDER] = at_start[0]
        right[row + 7] = waypoints[joint]
    matrix[size - 4 :, size - _ORDER :] = at_end[:4]
    right[size - 4] = waypoints[segments]
    _solve_banded(matrix, right)
    return right.reshape((segments, _ORDER, 3))


@njit(cache=True)
def _derivatives(s: float) -> NDArray[np.float64]:
    """Row r: the r-th derivative of each power at ``s``."""
    rows = np.zeros((_ORDER, _ORDER))
    for order in range(_ORDER):
        for power in range(order, _ORDER):
            factor = 1.0
            for k in range(order):
                factor *= power - k
            rows[order, power] = factor * s ** (power - order)
    return rows


@njit(cache=True)
def _solve_banded(matrix: NDArray[np.float64], right: NDArray[np.float64]) -> None:
    """Gauss elimination with row exchange inside the band; the solution replaces ``right``."""
    size = len(matrix)
    for k in range(size):
        below = min(k + _BAND + 1, size)
        beyond = min(k + 2 * _BAND + 1, size)
        pivot = k + np.argmax(np.abs(matrix[k:below, k]))
        if pivot != k:
            for column in range(k, beyond):
                matrix[k, column], matrix[pivot, column] = matrix[pivot, column], matrix[k, column]
            for axis in range(3):
                right[k, axis], right[pivot, axis] = right[pivot, axis], right[k, axis]
        for row in range(k + 1, below):
            factor = matrix[row, k] / matrix[k, k]
            if factor != 0.0:
                matrix[row, k:beyond] -= factor * matrix[k, k:beyond]
                right[row] -= factor * right[k]
    for k in range(size - 1, -1, -1):
        for column in range(k + 1, min(k + 2 * _BAND + 1, size)):
            right[k] -= matrix[k, column] * right[column]
        right[k] /= matrix[k, k]


@njit(cache=True)
def sample(
    coefficients: NDArray[np.float64], durations: NDArray[np.float64], times: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Position, velocity and acceleration (m, 9) at ``times`` (m,), ascending, s from the start."""
    rows = np.zeros((len(times), 9))
    segment = 0
    begun = 0.0
    for index in range(len(times)):
        while segment < len(durations) - 1 and times[index] - begun >= durations[segment]:
            begun += durations[segment]
            segment += 1
        duration = durations[segment]
        s = min((times[index] - begun) / duration, 1.0)
        for axis in range(3):
            p = v = a = 0.0
            for power in range(_ORDER - 1, -1, -1):
                a = a * s + 2.0 * v
                v = v * s + p
                p = p * s + coefficients[segment, power, axis]
            rows[index, axis] = p
            rows[index, 3 + axis] = v / duration
            rows[index, 6 + axis] = a / duration**2
    return rows


@njit(cache=True)
def excess(
    motion: NDArray[np.float64],
    times: NDArray[np.float64],
    durations: NDArray[np.float64],
    v_max: float,
    a_max: float,
) -> NDArray[np.float64]:
    """For each segment the factor (>= 1) by which its duration is too short for the limits.

    ``motion`` (m, 9) is the spline sampled at ``times`` (m,).
    """
    factors = np.ones(len(durations))
    ends = np.cumsum(durations)
    for index in range(len(times)):
        segment = min(np.searchsorted(ends, times[index], side="right"), len(durations) - 1)
        row = motion[index]
        speed = math.sqrt(row[3] ** 2 + row[4] ** 2 + row[5] ** 2)
        acceleration = math.sqrt(row[6] ** 2 + row[7] ** 2 + row[8] ** 2)
        factors[segment] = max(factors[segment], speed / v_max, math.sqrt(acceleration / a_max))
    return factors
