"""The flight controller: from a velocity command to the thrust of each rotor, at 250 Hz.

A cascade as in common autopilots: velocity (PI) -> thrust vector -> attitude (P) -> body rates (P)
-> rotors. It stands for the vehicle's firmware: part of the simulator, never a fault target, so it
has to keep the vehicle flying under any command that a corrupted stage sends it.

Frames: world x east, y north, z up; body x forward, y left, z up; quaternions (w, x, y, z).
"""

from __future__ import annotations

from math import atan2, cos, hypot, isfinite, pi, radians, sqrt, tan
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.vehicle.airframe import GRAVITY_M_S2, ROTORS, Airframe

Floats = NDArray[np.float64]

MAX_SPEED_M_S = 6.0
MAX_CLIMB_M_S = 3.0
MAX_YAW_RATE_RAD_S = 2.0
"""Flight envelope, wider than what the control stage may ask for (3 m/s, 90 deg/s: facts page)."""

MAX_TILT_RAD = radians(30.0)
"""Gives 5.7 m/s^2 level, a little over the planner's limit of 5 m/s^2."""

CLIMB_TILT_RAD = radians(15.0)
"""What is left to steer with in the hardest climb."""

MIN_COLLECTIVE, MAX_COLLECTIVE = 0.15, 0.92
"""Bounds of total thrust as a part of the largest: the rest is left for attitude."""

# Each loop is two to three times slower than the one inside it; the innermost stays below the
# bandwidth of the rotors (33 rad/s at a lag of 30 ms).
VELOCITY_P = 2.4  # 1/s
VELOCITY_I = 0.8  # 1/s^2
CLIMB_I = 2.0  # 1/s^2; rotors damp a climb more than anything damps level flight
MAX_INTEGRAL_M_S2 = 2.5
ATTITUDE_P = 6.0  # 1/s
YAW_P = 2.0  # 1/s
RATE_P = 18.0  # 1/s
YAW_RATE_P = 8.0  # 1/s
MAX_TILT_RATE_RAD_S = 4.0
MAX_YAW_LEAD_RAD = 0.5
"""How far the yaw setpoint may run ahead of the vehicle, so that it does not wind up."""

_SX = np.array([x for x, _, _ in ROTORS])
_SY = np.array([y for _, y, _ in ROTORS])
_SPIN = np.array([spin for _, _, spin in ROTORS])

Vector = tuple[float, float, float]


class Plant(NamedTuple):
    """What the controller knows of the airframe, and its own period."""

    period_s: float
    mass_kg: float
    inertia_x_kg_m2: float
    inertia_y_kg_m2: float
    inertia_z_kg_m2: float
    lever_m: float
    torque_per_thrust_m: float
    max_thrust_n: float
    min_lift_m_s2: float
    max_lift_m_s2: float


class AutopilotState(NamedTuple):
    """What the controller carries from one period to the next.

    ``setpoint`` (4,): the command in force; ``integral`` (3,): of the velocity error, m/s^2;
    ``yaw`` (1,): the yaw setpoint, rad.
    """

    setpoint: Floats
    integral: Floats
    yaw: Floats


class Autopilot:
    """The flight controller of one vehicle, hovering at ``yaw_rad`` until it gets a command."""

    def __init__(self, airframe: Airframe, period_s: float, yaw_rad: float) -> None:
        lift_m_s2 = len(ROTORS) * airframe.max_thrust_n / airframe.mass_kg
        self._plant = Plant(
            period_s,
            airframe.mass_kg,
            *airframe.inertia_kg_m2,
            airframe.lever_m,
            airframe.torque_per_thrust_m,
            airframe.max_thrust_n,
            MIN_COLLECTIVE * lift_m_s2,
            MAX_COLLECTIVE * lift_m_s2,
        )
        self._memory = AutopilotState(np.zeros(4), np.zeros(3), np.array([yaw_rad]))

    def command(self, velocity_command: Floats) -> None:
        """Takes up (vx, vy, vz, yaw rate), world frame, m/s and rad/s.

        A component that is not finite is no command: the last valid one of that component stays in
        force. Finite ones are limited to the flight envelope.
        """
        accept_setpoint(velocity_command, self._memory.setpoint)

    def update(self, pose: Floats, twist: Floats, thrust: Floats) -> None:
        """Writes the thrust of each rotor, newtons (4,), for one period.

        ``pose`` is (7,): position in m and quaternion, ``twist`` (6,): velocity in the world frame,
        m/s, and rates in the body frame, rad/s.
        """
        stabilise(self._plant, self._memory, pose, twist, thrust)


@njit(cache=True)
def clamp(value: float, limit: float) -> float:
    """``value`` limited to [-limit, limit]."""
    return min(max(value, -limit), limit)


@njit(cache=True)
def accept_setpoint(command: Floats, setpoint: Floats) -> None:
    """Overwrites the finite components of ``setpoint`` (vx, vy, vz, yaw rate), within the envelope."""
    for i in range(4):
        if isfinite(command[i]):
            setpoint[i] = command[i]
    # Each axis first: a corrupted component near the largest float has no finite norm.
    setpoint[0] = clamp(setpoint[0], MAX_SPEED_M_S)
    setpoint[1] = clamp(setpoint[1], MAX_SPEED_M_S)
    speed = hypot(setpoint[0], setpoint[1])
    if speed > MAX_SPEED_M_S:
        setpoint[0] *= MAX_SPEED_M_S / speed
        setpoint[1] *= MAX_SPEED_M_S / speed
    setpoint[2] = clamp(setpoint[2], MAX_CLIMB_M_S)
    setpoint[3] = clamp(setpoint[3], MAX_YAW_RATE_RAD_S)


@njit(cache=True)
def thrust_vector(plant: Plant, memory: AutopilotState, twist: Floats) -> Vector:
    """Thrust over mass that is asked for, world frame, m/s^2: PI on velocity, limited.

    Height comes before level speed, which gets what the rotors and the tilt limit leave. What is at its
    limit is not integrated further.
    """
    setpoint, integral = memory.setpoint, memory.integral
    most = plant.max_lift_m_s2
    error_x = setpoint[0] - twist[0]
    error_y = setpoint[1] - twist[1]
    error_z = setpoint[2] - twist[2]
    gain = VELOCITY_I * plant.period_s

    wanted = GRAVITY_M_S2 + VELOCITY_P * error_z + integral[2]
    up = min(max(wanted, plant.min_lift_m_s2), most * cos(CLIMB_TILT_RAD))
    if up == wanted:
        integral[2] = clamp(integral[2] + CLIMB_I * plant.period_s * error_z, MAX_INTEGRAL_M_S2)

    x = VELOCITY_P * error_x + integral[0]
    y = VELOCITY_P * error_y + integral[1]
    level = hypot(x, y)
    limit = min(up * tan(MAX_TILT_RAD), sqrt(most * most - up * up))
    if level > limit:
        return x * limit / level, y * limit / level, up
    integral[0] = clamp(integral[0] + gain * error_x, MAX_INTEGRAL_M_S2)
    integral[1] = clamp(integral[1] + gain * error_y, MAX_INTEGRAL_M_S2)
    return x, y, up


@njit(cache=True)
def rate_setpoint(plant: Plant, memory: AutopilotState, force: Vector, pose: Floats) -> Vector:
    """Body rates, rad/s, that turn the thrust axis to ``force`` and the nose to the yaw setpoint.

    Tilt and yaw are separate (reduced attitude control), so that a large yaw error never costs lift.
    """
    w, x, y, z = pose[3], pose[4], pose[5], pose[6]
    # The wanted thrust axis, in body coordinates.
    a = (1 - 2 * (y * y + z * z)) * force[0] + 2 * (x * y + w * z) * force[1] + 2 * (x * z - w * y) * force[2]
    b = 2 * (x * y - w * z) * force[0] + (1 - 2 * (x * x + z * z)) * force[1] + 2 * (y * z + w * x) * force[2]
    up_x, up_y, up_z = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    c = 2 * (x * z + w * y) * force[0] + 2 * (y * z - w * x) * force[1] + up_z * force[2]
    off_axis = hypot(a, b)
    turn = min(ATTITUDE_P * atan2(off_axis, c), MAX_TILT_RATE_RAD_S)
    scale = turn / off_axis if off_axis > 0.0 else 0.0

    yaw = atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    yaw_rate = memory.setpoint[3]
    lead = memory.yaw[0] + yaw_rate * plant.period_s - yaw
    lead = clamp(lead - 2 * pi * round(lead / (2 * pi)), MAX_YAW_LEAD_RAD)
    memory.yaw[0] = yaw + lead
    spin = clamp(YAW_P * lead + yaw_rate, MAX_YAW_RATE_RAD_S)
    # A turn about the world's vertical, seen from the body.
    return -b * scale + spin * up_x, a * scale + spin * up_y, spin * up_z


@njit(cache=True)
def mix(lift_n: float, torque: Vector, plant: Plant, thrust: Floats) -> None:
    """Thrust of each rotor, newtons (4,), for a lift and a torque about x, y, z in newton metres.

    The sign vectors of the four columns are orthogonal, which inverts the allocation in place.
    Where a rotor reaches a limit, yaw gives way first.
    """
    room = plant.max_thrust_n
    yaw_part = torque[2] / (4 * plant.torque_per_thrust_m)
    for i in range(4):
        thrust[i] = lift_n / 4 + (_SY[i] * torque[0] - _SX[i] * torque[1]) / (4 * plant.lever_m)
        room = min(room, thrust[i], plant.max_thrust_n - thrust[i])
    yaw_part = clamp(yaw_part, max(room, 0.0))
    for i in range(4):
        thrust[i] = min(max(thrust[i] + _SPIN[i] * yaw_part, 0.0), plant.max_thrust_n)


@njit(cache=True)
def stabilise(plant: Plant, memory: AutopilotState, pose: Floats, twist: Floats, thrust: Floats) -> None:
    """One period of the whole cascade; arguments as in :meth:`Autopilot.update`."""
    force = thrust_vector(plant, memory, twist)
    rates = rate_setpoint(plant, memory, force, pose)

    w, x, y, z = pose[3], pose[4], pose[5], pose[6]
    # Only the part of the wanted force along the present thrust axis: none in a wrong direction.
    along = 2 * (x * z + w * y) * force[0] + 2 * (y * z - w * x) * force[1]
    along += (1 - 2 * (x * x + y * y)) * force[2]
    lift = min(max(along, plant.min_lift_m_s2), plant.max_lift_m_s2)

    p, q, r = twist[3], twist[4], twist[5]
    ix, iy, iz = plant.inertia_x_kg_m2, plant.inertia_y_kg_m2, plant.inertia_z_kg_m2
    torque = (
        ix * RATE_P * (rates[0] - p) + q * r * (iz - iy),
        iy * RATE_P * (rates[1] - q) + r * p * (ix - iz),
        iz * YAW_RATE_P * (rates[2] - r) + p * q * (iy - ix),
    )
    mix(plant.mass_kg * lift, torque, plant, thrust)
