"""What an airframe is: the one definition, shared by files, specifications and the simulator."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from services.models.base import Strict

Positive = Annotated[float, Field(gt=0, le=1e6)]


class AirframeDefinition(Strict):
    """A quadrotor in X. Body frame: x forward, y left, z up, origin in the centre of mass.

    ``arm_m`` reaches from the centre to a rotor's axis. ``body_box_m`` and ``motor_kg`` (each of four,
    part of ``mass_kg``) give the inertia. The hull, which is what touches things, is an upright cylinder
    out to the rotors' tips. Drag is linear, newtons per m/s of air speed: ``level_drag_n_s_m`` sideways,
    ``heave_drag_n_s_m`` up and down, where the rotors' own inflow damps most. ``hover_efficiency`` is the
    ideal induced power over the electrical one of motors and rotors, ``avionics_w`` what everything else
    draws; ``power_model`` says which of the two energy models (``sim/vehicle/energy.py``) fits the vehicle.
    ``source`` says where the figures come from and which are assumed.
    """

    name: str = Field(min_length=1, max_length=60, pattern=r"^[A-Za-z0-9._-]+$")
    source: str = ""
    mass_kg: Positive
    arm_m: Positive
    rotor_diameter_m: Positive
    thrust_coefficient: Positive
    power_coefficient: Positive
    max_rpm: Positive
    rotor_time_constant_s: float = Field(ge=0.004, le=0.2)
    body_box_m: tuple[Positive, Positive, Positive]
    motor_kg: Positive
    level_drag_n_s_m: float = Field(ge=0, le=100)
    heave_drag_n_s_m: float = Field(ge=0, le=100)
    hull_height_m: Positive
    battery_v: Positive
    battery_ah: Positive
    power_model: Literal["regression", "momentum"]
    hover_efficiency: float = Field(gt=0, le=1)
    avionics_w: float = Field(default=0.0, ge=0, le=1e4)
