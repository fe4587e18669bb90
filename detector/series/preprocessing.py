"""Preprocessing: sign and exponent bits of a float64 as a 16-bit integer, then the change of that integer.

The paper (section V-B) watches these 12 bits only, as a fault in the mantissa hardly matters. It does not say
which integer they make. Read as they stand (``naive``), a value that passes through zero jumps by 2048, and
one that falls from 0.1 to 1e-17, which is nothing to a vehicle, by 50: golden flights do both all the time,
and a detector that must bear that is blind. So they are *folded*: with E the exponent and a floor F,

    level = sign * max(0, E - F + 1),

0 for everything below 2^F, +-1 up to 2^(F+1), and so on. F is the least power of two that one step of a
golden flight hardly exceeds: a smaller value may be anything else one step later. Then a golden step changes
the level by 1 or 2 anywhere, and passing through zero is a small step like any other.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detector.series.monitored_states import DURATION

FORMS: Mapping[str, int] = MappingProxyType({"folded": 0, "naive": 1, "raw": 2})
"""``naive`` and ``raw`` (the values themselves) are there to be measured against."""

FLOORS: Mapping[str, int] = MappingProxyType(
    {
        **{f"trajectory.{axis}": 0 for axis in "xyz"},  # 3 m/s for 0.25 s: 0.75 m
        **{f"trajectory.v{axis}": 0 for axis in "xyz"},  # 5 m/s^2 for 0.25 s: 1.25 m/s
        **{f"trajectory.a{axis}": 2 for axis in "xyz"},  # the largest seen: 3.7 m/s^2
        **{f"command.v{axis}": -1 for axis in "xyz"},  # the largest seen in 40 ms: 0.34 m/s
        "command.yaw_rate": 0,
        "collision_check.time_to_collision": 0,
        "collision_check.future_collision_seq": 0,
        "trajectory.t": -2,  # rows are 0.25 s apart
        "trajectory.yaw": -1,
        "trajectory.trajectory_seq": 0,
        "trajectory.future_collision_seq": 0,
        DURATION: -4,  # it hardly changes within a curve
    }
)
"""F of each state: values below 2^F of its unit are its zero."""

NONE_IS_ZERO = frozenset({"collision_check.time_to_collision"})
"""States of which infinity says: there is none. To a change that is zero."""

_EXPONENT = 0x7FF
_BIAS = 1023


@njit(cache=True, inline="always")
def level(bits: int, value: float, floor: int, none_is_zero: bool, form: int) -> float:
    """The number whose change is watched, of a float64 given as its ``bits`` and its ``value``.

    NaN and infinity have the exponent 1024, so they are far from every number; raw, where they cannot be
    told by their bits, they are the largest number.
    """
    exponent = (bits >> 52) & _EXPONENT
    if none_is_zero and exponent == _EXPONENT and bits > 0:
        return 0.0
    if form == 1:
        return float((bits >> 52) & 0xFFF)
    if form == 2:
        return value if exponent != _EXPONENT else 1e300
    height = max(exponent - _BIAS - floor + 1, 0)
    return float(-height if bits < 0 else height)


@njit(cache=True)
def _levels(
    bits: NDArray[np.int64], values: NDArray[np.float64], floor: int, none: bool, form: int
) -> NDArray[np.float64]:
    out = np.empty(len(values))
    for index in range(len(values)):
        out[index] = level(bits[index], values[index], floor, none, form)
    return out


def levels(state: str, values: NDArray[np.float64], form: str = "folded") -> NDArray[np.float64]:
    """The level of each of the ``values`` (n,) of a state; a whole number unless the form is raw."""
    flat = np.ascontiguousarray(values, dtype=np.float64)
    return _levels(flat.view(np.int64), flat, FLOORS[state], state in NONE_IS_ZERO, FORMS[form])
