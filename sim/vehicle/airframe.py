"""Airframes: what follows from a definition, and the ones that come along (``sim/airframes``).

Body frame: x forward, y left, z up, origin in the centre of mass.
"""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.resources import files
from math import pi, sqrt

from services.models.airframe import AirframeDefinition

GRAVITY_M_S2 = 9.81

AIR_DENSITY_KG_M3 = 1.225
"""Sea level, standard atmosphere."""

ROTORS = ((1.0, 1.0, -1.0), (-1.0, 1.0, 1.0), (-1.0, -1.0, -1.0), (1.0, -1.0, 1.0))
"""Quadrotor in X: for each rotor the sign of its x, of its y and of its reaction torque about z.

Front left, rear left, rear right, front right; neighbours turn in opposite directions.
"""

LEAST_THRUST_TO_WEIGHT = 1.2
"""Below it the flight controller could neither climb nor steer."""


class BadAirframeError(ValueError):
    """No airframe of that name, or one that could not fly."""


class Airframe(AirframeDefinition):
    """A definition with what follows from it."""

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
        """The weight in newtons: mass times gravity."""
        return self.mass_kg * GRAVITY_M_S2

    @property
    def thrust_to_weight(self) -> float:
        """The ratio of the largest lift of all rotors to the weight."""
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
        """The radius of the hull in metres, out to the tips of the rotors."""
        return self.arm_m + self.rotor_diameter_m / 2

    @property
    def battery_kj(self) -> float:
        """The energy of a fully charged battery in kJ."""
        return self.battery_v * self.battery_ah * 3.6

    @property
    def disc_area_m2(self) -> float:
        """The area that one rotor sweeps, in square metres."""
        return pi * (self.rotor_diameter_m / 2) ** 2


def airframe_names() -> list[str]:
    """The airframes that come along, sorted."""
    names = (entry.name for entry in (files("sim") / "airframes").iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


@cache
def airframe(asked: str | AirframeDefinition) -> Airframe:
    """The airframe of that name, or of that definition.

    :raises BadAirframeError: if there is no such name, or if the vehicle could not fly.
    """
    if isinstance(asked, str):
        if asked not in airframe_names():
            message = f"unknown airframe {asked!r}; known: {', '.join(airframe_names())}"
            raise BadAirframeError(message)
        text = (files("sim") / "airframes" / f"{asked}.toml").read_text()
        made = Airframe.model_validate(tomllib.loads(text))
    else:
        made = Airframe.model_validate(asked.model_dump())
    if made.thrust_to_weight < LEAST_THRUST_TO_WEIGHT:
        message = (
            f"airframe {made.name}: lift of {made.thrust_to_weight:.2f} times the weight"
            f" (max_rpm {made.max_rpm:g}), needs {LEAST_THRUST_TO_WEIGHT}"
        )
        raise BadAirframeError(message)
    if made.motor_kg * len(ROTORS) >= made.mass_kg:
        message = (
            f"airframe {made.name}: motor_kg {made.motor_kg:g}: four are all of mass_kg {made.mass_kg:g}"
        )
        raise BadAirframeError(message)
    return made
