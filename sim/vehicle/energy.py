"""Energy consumption of a flight, by MAVBench's regression or by momentum theory.

The regression (facts page, "Energy and airframes") was fitted to one vehicle of about the AirSim UAV's size:

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

Momentum theory (Leishman, Principles of Helicopter Aerodynamics, 2nd ed., sections 2.13 and 2.14) goes for
every airframe: a rotor that lifts T at axial air speed V_a and level air speed V_l induces v_i with
v_i = v_h^2 / sqrt(V_l^2 + (V_a + v_i)^2), v_h^2 = T / (2 rho A), and draws T (V_a + v_i) over the
efficiency that the airframe has in hover. The air is taken to be at rest.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

from numba import njit

from sim.vehicle.airframe import AIR_DENSITY_KG_M3, GRAVITY_M_S2, ROTORS, Airframe

KM_H = 3.6
"""km/h in one m/s, and km/h per s in one m/s^2."""

C1, C2, C3 = -1.526, 3.934, 0.968
C4, C5, C6 = 18.125, 96.613, -1.085
C7_MASS_W = 2 * 0.22
C9_W = 443.9

_NEWTON_STEPS = 8
_ROTORS = len(ROTORS)


class PowerModel(NamedTuple):
    """Which model is used, and what momentum theory knows of the airframe."""

    by_regression: bool
    mass_kg: float
    level_drag_n_s_m: float
    heave_drag_n_s_m: float
    disc_area_m2: float
    hover_efficiency: float
    avionics_w: float


def power_model(airframe: Airframe, energy: str) -> PowerModel:
    """The model ``energy``: "regression", "momentum", or "airframe" for the one that fits the vehicle."""
    return PowerModel(
        by_regression=(airframe.power_model if energy == "airframe" else energy) == "regression",
        mass_kg=airframe.mass_kg,
        level_drag_n_s_m=airframe.level_drag_n_s_m,
        heave_drag_n_s_m=airframe.heave_drag_n_s_m,
        disc_area_m2=airframe.disc_area_m2,
        hover_efficiency=airframe.hover_efficiency,
        avionics_w=airframe.avionics_w,
    )


@njit(cache=True)
def regression_w(v_xy: float, a_xy: float, v_z: float, a_z: float) -> float:
    """Electrical power of the rotors in W, never negative.

    Level and vertical velocity in m/s and acceleration in m/s^2; their signs do not matter.
    """
    v_level, a_level = abs(v_xy) * KM_H, abs(a_xy) * KM_H
    v_vertical, a_vertical = abs(v_z) * KM_H, abs(a_z) * KM_H
    level = C1 * v_level + C2 * a_level + C3 * v_level * a_level
    vertical = C4 * v_vertical + C5 * a_vertical + C6 * v_vertical * a_vertical
    return max(level + vertical + C7_MASS_W + C9_W, 0.0)


@njit(cache=True)
def induced_m_s(thrust_n: float, area_m2: float, axial_m_s: float, level_m_s: float) -> float:
    """Velocity that a rotor induces in its disc, by Newton's method from the hover value.

    ``axial_m_s`` is the air speed along the thrust, positive in a climb. A descent faster than the hover
    value, where momentum theory ends in the vortex ring, counts as one at that speed.
    """
    hover_squared = thrust_n / (2.0 * AIR_DENSITY_KG_M3 * area_m2)
    induced = sqrt(hover_squared)
    axial = max(axial_m_s, -induced)
    if thrust_n <= 0.0:
        return 0.0
    for _ in range(_NEWTON_STEPS):
        through = axial + induced
        speed_squared = level_m_s * level_m_s + through * through
        excess = induced * induced * speed_squared - hover_squared * hover_squared
        slope = 2.0 * induced * speed_squared + 2.0 * induced * induced * through
        induced -= excess / slope
    return induced


@njit(cache=True)
def momentum_w(
    model: PowerModel, velocity: tuple[float, float, float], acceleration: tuple[float, float, float]
) -> float:
    """Electrical power in W at a velocity in m/s and an acceleration in m/s^2, world frame."""
    x = model.mass_kg * acceleration[0] + model.level_drag_n_s_m * velocity[0]
    y = model.mass_kg * acceleration[1] + model.level_drag_n_s_m * velocity[1]
    z = model.mass_kg * (acceleration[2] + GRAVITY_M_S2) + model.heave_drag_n_s_m * velocity[2]
    thrust = sqrt(x * x + y * y + z * z)
    if thrust == 0.0:
        return model.avionics_w
    axial = (x * velocity[0] + y * velocity[1] + z * velocity[2]) / thrust
    level = sqrt(max(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2 - axial * axial, 0.0))
    induced = induced_m_s(thrust / _ROTORS, model.disc_area_m2, axial, level)
    return model.avionics_w + max(thrust * (axial + induced), 0.0) / model.hover_efficiency
