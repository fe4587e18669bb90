"""Energy: what the rotors draw, by MAVBench's regression (facts page, "Energy and airframes").

P = c1 |v_xy| + c2 |a_xy| + c3 |v_xy| |a_xy| + c4 |v_z| + c5 |a_z| + c6 |v_z| |a_z| + c7 m + c9, in W.

Units. The coefficients are given with speeds in km/h. For accelerations three readings are possible,
and the paper's golden flight (Table III: 94.6 s, 49.5 m, 51.4 kJ) tells them apart. It draws 543 W at
a mean of 0.52 m/s. Hovering is 444 W in every reading and level speed lowers that by a few watts, so
accelerations have to bring 99 W, nearly all of it through c5, the largest coefficient:

- km/h per s: a mean |a_z| of 0.2 m/s^2 brings 70 W; with |a_xy| at 0.5 m/s^2 and |v_z| at 0.2 m/s the
  sum is 534 W. An ordinary stop-and-go flight.
- SI throughout: needs a mean |a_z| of 1 m/s^2, as much as going from rest to 3 m/s and back every 6 s
  in the vertical alone, in a flight that hardly changes its height.
- km/h per h: the flight of the first reading would draw a quarter of a megawatt.

So it is km/h and km/h per s.
"""

from __future__ import annotations

from numba import njit

KM_H = 3.6
"""km/h in one m/s, and km/h per s in one m/s^2."""

C1, C2, C3 = -1.526, 3.934, 0.968
C4, C5, C6 = 18.125, 96.613, -1.085
C7_MASS_W = 2 * 0.22
C9_W = 443.9


@njit(cache=True)
def power_w(v_xy: float, a_xy: float, v_z: float, a_z: float) -> float:
    """Electrical power of the rotors in W, never negative.

    Level and vertical velocity in m/s and acceleration in m/s^2; their signs do not matter.
    """
    v_level, a_level = abs(v_xy) * KM_H, abs(a_xy) * KM_H
    v_vertical, a_vertical = abs(v_z) * KM_H, abs(a_z) * KM_H
    level = C1 * v_level + C2 * a_level + C3 * v_level * a_level
    vertical = C4 * v_vertical + C5 * a_vertical + C6 * v_vertical * a_vertical
    return max(level + vertical + C7_MASS_W + C9_W, 0.0)
