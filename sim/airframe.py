"""Airframes: what a vehicle weighs, measures, lifts and stores.

Body frame: x forward, y left, z up, origin in the centre of mass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi, sqrt
from types import MappingProxyType

GRAVITY_M_S2 = 9.81

AIR_DENSITY_KG_M3 = 1.225
"""Sea level, standard atmosphere."""

ROTORS = ((1.0, 1.0, -1.0), (-1.0, 1.0, 1.0), (-1.0, -1.0, -1.0), (1.0, -1.0, 1.0))
"""Quadrotor in X: for each rotor the sign of its x, of its y and of its reaction torque about z.

Front left, rear left, rear right, front right; neighbours turn in opposite directions.
"""


class UnknownAirframeError(ValueError):
    """An airframe was asked for by a name that is not in ``AIRFRAMES``."""


@dataclass(frozen=True, slots=True)
class Airframe:
    """A quadrotor in X.

    ``arm_m`` reaches from the centre to a rotor's axis. Inertia is that of a solid box with four
    point masses (the motors, ``motor_kg`` each, part of ``mass_kg``) at the ends of the arms.
    ``drag_n_s_m`` is linear drag, newtons per m/s. The hull, which is what touches things, is an
    upright cylinder around the centre.
    """

    name: str
    mass_kg: float
    arm_m: float
    rotor_diameter_m: float
    thrust_coefficient: float
    power_coefficient: float
    max_rpm: float
    rotor_time_constant_s: float
    body_box_m: tuple[float, float, float]
    motor_kg: float
    drag_n_s_m: float
    hull_height_m: float
    battery_v: float
    battery_ah: float

    @property
    def max_thrust_n(self) -> float:
        """Largest thrust of one rotor: C_T rho n^2 D^4, n in revolutions per second."""
        n = self.max_rpm / 60
        return self.thrust_coefficient * AIR_DENSITY_KG_M3 * n**2 * self.rotor_diameter_m**4

    @property
    def torque_per_thrust_m(self) -> float:
        """Reaction torque of a rotor over its thrust: C_P D / (2 pi C_T)."""
        return self.power_coefficient * self.rotor_diameter_m / (2 * pi * self.thrust_coefficient)

    @property
    def weight_n(self) -> float:
        """Mass times gravity."""
        return self.mass_kg * GRAVITY_M_S2

    @property
    def thrust_to_weight(self) -> float:
        """Largest lift over weight."""
        return len(ROTORS) * self.max_thrust_n / self.weight_n

    @property
    def lever_m(self) -> float:
        """Distance of a rotor's axis from the body's x axis, and from its y axis."""
        return self.arm_m / sqrt(2)

    @property
    def inertia_kg_m2(self) -> tuple[float, float, float]:
        """Principal moments of inertia about x, y, z."""
        x, y, z = self.body_box_m
        box_kg = self.mass_kg - len(ROTORS) * self.motor_kg
        motors = len(ROTORS) * self.motor_kg * self.lever_m**2
        return (
            box_kg / 12 * (y**2 + z**2) + motors,
            box_kg / 12 * (x**2 + z**2) + motors,
            box_kg / 12 * (x**2 + y**2) + 2 * motors,
        )

    @property
    def hull_radius_m(self) -> float:
        """Out to the tips of the rotors."""
        return self.arm_m + self.rotor_diameter_m / 2

    @property
    def battery_kj(self) -> float:
        """Energy of a full charge."""
        return self.battery_v * self.battery_ah * 3.6


def airframe(name: str) -> Airframe:
    """The airframe of that name.

    :raises UnknownAirframeError: if ``AIRFRAMES`` has no such name.
    """
    if name not in AIRFRAMES:
        message = f"unknown airframe {name!r}; known: {', '.join(sorted(AIRFRAMES))}"
        raise UnknownAirframeError(message)
    return AIRFRAMES[name]


_TABLE = (
    # Mass, arm, rotors and battery: facts page, "Energy and airframes". The rest is assumed:
    # - rotor lag 30 ms, within the 20-50 ms of motors with 13 inch propellers (AirSim filters its
    #   rotors with 5 ms, which no real one of that size reaches);
    # - body box and motor weight in proportion to AirSim's frames of 2 kg (box 0.20 m, motor 0.1 kg);
    # - drag 0.25 N s/m per kg, rotor drag of small quadrotors at the paper's speeds.
    Airframe(
        name="airsim",
        mass_kg=2.431,
        arm_m=0.325,
        rotor_diameter_m=0.3302,
        thrust_coefficient=0.027122,
        power_coefficient=0.033526,
        max_rpm=8750.0,
        rotor_time_constant_s=0.03,
        body_box_m=(0.20, 0.20, 0.10),
        motor_kg=0.1,
        drag_n_s_m=0.6,
        hull_height_m=0.2,
        battery_v=11.1,
        battery_ah=5.5,
    ),
)

AIRFRAMES: Mapping[str, Airframe] = MappingProxyType({entry.name: entry for entry in _TABLE})
