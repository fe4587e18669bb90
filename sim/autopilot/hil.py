"""What an autopilot is told of the vehicle, as fields of MAVLink's HIL messages, and what it has rotors do.

MAVLink's world frame is north, east, down, its body frame forward, right, down; ours are east, north, up and
forward, left, up.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, degrees, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.bus.arrays import inverse, rotated
from services.models.equipment import Imu
from services.runtime.rng import generator
from sim.vehicle.airframe import GRAVITY_M_S2

Floats = NDArray[np.float64]
Values = dict[str, float | tuple[float, ...]]

HOME = (47.397742, 8.545594, 488.0)
"""Latitude and longitude in degrees, height in m: where PX4's own simulators begin."""

_OURS = (2, 1, 3, 0)
"""PX4's motors (front right, rear left, front left, rear right) in the order of ``ROTORS``."""

_EARTH_M = 6_371_000.0
_FIELD_GAUSS = np.array([0.0080, 0.2148, -0.4282])
"""The earth's magnetic field there: east, north, up."""

_FIELD_NOISE_GAUSS, _PRESSURE_NOISE_HPA = 0.001, 0.01
_BLOCK = 256
_ALL_UPDATED = 0x1FFF


class HilState(NamedTuple):
    """The vehicle at one moment: m, m/s, attitude (w, x, y, z), world frame; rates and force, body frame."""

    position: Floats
    velocity: Floats
    attitude: Floats
    rates: Floats
    force: Floats


def specific_force(before: Floats, after: Floats, period_s: float, attitude: Floats) -> Floats:
    """What an accelerometer reads, body frame, m/s^2, while the velocity (world frame) changes so."""
    felt = (after - before) / period_s + (0.0, 0.0, GRAVITY_M_S2)
    return rotated(felt, inverse(attitude))


def to_ned(enu: Floats) -> tuple[float, float, float]:
    """A vector of our world frame in MAVLink's."""
    return float(enu[1]), float(enu[0]), -float(enu[2])


def to_frd(flu: Floats) -> tuple[float, float, float]:
    """A vector of our body frame in MAVLink's."""
    return float(flu[0]), -float(flu[1]), -float(flu[2])


def to_ned_frd(attitude: Floats) -> tuple[float, float, float, float]:
    """An attitude (w, x, y, z) between our frames as one between MAVLink's.

    That is (0, 1, 1, 0) / sqrt 2 * q * (0, 1, 0, 0): what turns the world, and what turns the body.
    """
    w, x, y, z = attitude.tolist()
    half = 0.5**0.5
    sign = half if w + z >= 0 else -half
    return sign * (w + z), sign * (x + y), sign * (x - y), sign * (w - z)


class HilSensors:
    """The sensors of one flight, with the IMU's white noise; the same seed gives the same readings."""

    def __init__(self, imu: Imu, seed: int) -> None:
        self._seed, self._taken = seed, 0
        self._noise: Floats = np.empty((0, 10))
        self._deviation = np.array(
            [imu.accel_noise_m_s2] * 3
            + [imu.gyro_noise_rad_s] * 3
            + [_FIELD_NOISE_GAUSS] * 3
            + [_PRESSURE_NOISE_HPA]
        )

    def sensor(self, state: HilState) -> Values:
        """The fields of HIL_SENSOR but its time."""
        block, place = divmod(self._taken, _BLOCK)
        if place == 0:
            drawn = generator(self._seed, "autopilot sensors", block).standard_normal((_BLOCK, 10))
            self._noise = drawn * self._deviation
        self._taken += 1
        noise = self._noise[place]
        force, rates = to_frd(state.force + noise[:3]), to_frd(state.rates + noise[3:6])
        field = to_frd(rotated(_FIELD_GAUSS, inverse(state.attitude)) + noise[6:9])
        altitude_m = HOME[2] + float(state.position[2])
        pressure = 1013.25 * (1 - 2.25577e-5 * altitude_m) ** 5.25588 + float(noise[9])
        parts = zip(("acc", "gyro", "mag"), (force, rates, field), strict=True)
        return {
            **{f"{axis}{what}": value for what, xyz in parts for axis, value in zip("xyz", xyz, strict=True)},
            "abs_pressure": pressure,
            "pressure_alt": altitude_m,
            "temperature": 25.0,
            "fields_updated": _ALL_UPDATED,
        }


def gps(state: HilState) -> Values:
    """The fields of HIL_GPS but its time."""
    north, east, down = (round(100 * part) for part in to_ned(state.velocity))
    return {
        "fix_type": 3,
        **_place(state.position),
        "eph": 100,
        "epv": 100,
        "vel": round((north**2 + east**2) ** 0.5),
        "vn": north,
        "ve": east,
        "vd": down,
        "cog": 65535,
        "satellites_visible": 10,
    }


def truth(state: HilState) -> Values:
    """The fields of HIL_STATE_QUATERNION but its time."""
    north, east, down = (round(100 * part) for part in to_ned(state.velocity))
    roll, pitch, yaw = to_frd(state.rates)
    forces = (round(part / GRAVITY_M_S2 * 1000) for part in to_frd(state.force))
    return {
        "attitude_quaternion": to_ned_frd(state.attitude),
        "rollspeed": roll,
        "pitchspeed": pitch,
        "yawspeed": yaw,
        **_place(state.position),
        "vx": north,
        "vy": east,
        "vz": down,
        **{f"{axis}acc": min(max(part, -32768), 32767) for axis, part in zip("xyz", forces, strict=True)},
    }


def relative_thrusts(controls: Sequence[float]) -> Floats:
    """The thrust of each rotor, (4,) in the order of ``ROTORS``, as a part of what it can give.

    ``controls`` are those of HIL_ACTUATOR_CONTROLS, 0 to 1; NaN is a motor that is off. A rotor's speed is
    proportional to its control, its thrust to the square of that.
    """
    ours = np.array([controls[motor] for motor in _OURS])
    return np.asarray(np.clip(np.nan_to_num(ours, nan=0.0), 0.0, 1.0) ** 2)


def _place(position: Floats) -> Values:
    latitude, longitude, height_m = HOME
    north, east, down = to_ned(position)
    return {
        "lat": round(1e7 * (latitude + degrees(north / _EARTH_M))),
        "lon": round(1e7 * (longitude + degrees(east / (_EARTH_M * cos(radians(latitude)))))),
        "alt": round(1e3 * (height_m - down)),
    }
