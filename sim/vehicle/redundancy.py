"""The cost of redundant computers: safe velocity by the visual performance ("F-1") model.

Krishnan et al., "The Sky Is Not the Limit: A Visual Performance Model for Cyber-Physical Co-Design in
Autonomous Machines", IEEE Computer Architecture Letters 19 (2020): a vehicle that sees d ahead and reacts
within T stops in time at v = a (sqrt(T^2 + 2 d / a) - T). Its acceleration a = g sqrt((T/W)^2 - 1) is what
the lift leaves beside the weight, to which every further computer adds its own. A mission of given length
takes time in inverse proportion to v. What was assumed of the inputs: ``docs/world.md``.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import sqrt
from types import MappingProxyType

from pydantic import Field

from services.models.airframe import AirframeDefinition
from services.models.base import Strict
from sim.vehicle.airframe import GRAVITY_M_S2, airframe

COMPUTERS: Mapping[str, int] = MappingProxyType({"simplex": 1, "DMR": 2, "TMR": 3})


class RedundancyStudy(Strict):
    """The inputs. The airframe's mass holds one computer already.

    ``response_s``: the slowest of sensor, computer and control, 1 / min(f_sensor, f_compute, f_control); the
    default is the paper's occupancy map, 289 ms. ``range_m``: the paper's mapping range. ``computer_kg``: a
    Jetson TX2 module with its heat spreader.
    """

    airframe: str | AirframeDefinition = "airsim"
    response_s: float = Field(default=0.289, ge=0, le=60)
    range_m: float = Field(default=7.0, gt=0, le=1000)
    computer_kg: float = Field(default=0.085, ge=0, le=100)


class RedundancyResult(Strict):
    """One scheme. ``time_factor`` over simplex is None where the vehicle can no longer lift itself."""

    scheme: str
    mass_kg: float
    thrust_to_weight: float
    acceleration_m_s2: float
    safe_velocity_m_s: float
    time_factor: float | None


def acceleration_m_s2(thrust_to_weight: float) -> float:
    """Level acceleration at full lift and constant height; 0 if the lift does not exceed the weight."""
    return GRAVITY_M_S2 * sqrt(max(thrust_to_weight**2 - 1.0, 0.0))


def safe_velocity_m_s(acceleration: float, response_s: float, range_m: float) -> float:
    """The velocity from which the vehicle stops within ``range_m``, ``response_s`` of it flown blindly."""
    if acceleration == 0.0:
        return 0.0
    return acceleration * (sqrt(response_s**2 + 2.0 * range_m / acceleration) - response_s)


def study(asked: RedundancyStudy) -> list[RedundancyResult]:
    """Simplex, DMR and TMR on one airframe, in this order."""
    frame = airframe(asked.airframe)
    results: list[RedundancyResult] = []
    for scheme, computers in COMPUTERS.items():
        mass_kg = frame.mass_kg + (computers - 1) * asked.computer_kg
        lift = frame.thrust_to_weight * frame.mass_kg / mass_kg
        acceleration = acceleration_m_s2(lift)
        velocity = safe_velocity_m_s(acceleration, asked.response_s, asked.range_m)
        alone = results[0].safe_velocity_m_s if results else velocity
        results.append(
            RedundancyResult(
                scheme=scheme,
                mass_kg=mass_kg,
                thrust_to_weight=lift,
                acceleration_m_s2=acceleration,
                safe_velocity_m_s=velocity,
                time_factor=alone / velocity if velocity else None,
            )
        )
    return results
