"""Kernel: trajectory following, a PID on the position error added to the trajectory's velocity."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.models.pilots import GuardName, Guards, Pilot
from services.models.safety import SPEED_LIMIT_M_S

YAW_RATE_LIMIT_RAD_S = math.radians(90.0)
"""Facts page, "control"."""

_YAW_PROPORTIONAL = 2.0  # 1/s
_YAW_DEADBAND_RAD = math.radians(1.0)
_ERROR_LIMIT_M = 10.0  # an error beyond it is not believed to its full size
_INTEGRAL_LIMIT_M_S = 2.0

STATE_SIZE = 3
"""The state of the controller: the integrated position error, m s. All zero at the start."""

REPORT_SIZE = 4
PACE = 0
"""In the report on a command: the part of itself to which its level speed was limited, 1 if it was not."""

KERNEL_GUARDS: tuple[GuardName, ...] = ("finite", "limits", "clip")
"""The guards within the kernel; in the report, after the pace: how often each acted."""

_FINITE, _LIMITS, _CLIP = 1, 2, 3


class Tuning(NamedTuple):
    """What a pilot and its guards make of the controller; gains as in :class:`services.models.pilots.Pilot`.

    ``held``: the trajectory's first row is flown as it stands, whatever the time.
    """

    proportional_level: float
    proportional_vertical: float
    integral: float
    derivative: float
    held: bool
    finite: bool
    limits: bool
    clip: bool


def tuning(pilot: Pilot, guards: Guards) -> Tuning:
    """The controller of a pilot with these guards."""
    return Tuning(
        pilot.proportional_level,
        pilot.proportional_vertical,
        pilot.integral,
        pilot.derivative,
        "dense" not in guards,
        *(name in guards for name in KERNEL_GUARDS),
    )


@njit(cache=True)
def pid(
    trajectory: NDArray[np.float64],
    now_s: float,
    position: NDArray[np.float64],
    velocity: NDArray[np.float64],
    yaw: float,
    period_s: float,
    state: NDArray[np.float64],
    tuning: Tuning,
    report: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Flight command (vx, vy, vz, yaw rate), world frame, m/s and rad/s.

    ``trajectory`` (n, 12) as it stands on the bus, n >= 1; ``position`` and ``velocity`` (3,) world
    frame; ``period_s`` since the last command. ``state`` is updated, ``report`` written.

    v = v_traj + P e + I integral(e) + D e'. By the guards: finite, errors that are not finite count as
    zero; limits, errors are believed up to a size; clip, the command is limited to ``SPEED_LIMIT_M_S``
    horizontally and vertically, and to the largest yaw rate.
    """
    target = held_state(trajectory) if tuning.held else state_at(trajectory, now_s)
    command = np.zeros(4)
    report[:] = 0.0
    for axis in range(3):
        gain = tuning.proportional_vertical if axis == 2 else tuning.proportional_level
        error = _believed(target[axis] - position[axis], _ERROR_LIMIT_M, tuning, report)
        # What has no gain is not summed up: zero times infinity would be no number.
        slip = 0.0
        if tuning.derivative != 0.0:
            slip = _believed(target[3 + axis] - velocity[axis], 2.0 * SPEED_LIMIT_M_S, tuning, report)
        if tuning.integral != 0.0:
            state[axis] = _believed(state[axis] + error * period_s, _INTEGRAL_LIMIT_M_S, tuning, report)
        feedback = gain * error + tuning.integral * state[axis] + tuning.derivative * slip
        command[axis] = _believed(target[3 + axis], SPEED_LIMIT_M_S, tuning, report) + feedback
    speed = math.hypot(command[0], command[1])
    report[PACE] = 1.0
    if tuning.clip and speed > SPEED_LIMIT_M_S:
        report[PACE] = SPEED_LIMIT_M_S / speed
        command[:2] *= SPEED_LIMIT_M_S / speed
    off = _shortest_turn(yaw, target[9])
    turn = _YAW_PROPORTIONAL * off if abs(off) > _YAW_DEADBAND_RAD else 0.0
    command[3] = _believed(target[10], YAW_RATE_LIMIT_RAD_S, tuning, report) + turn
    if tuning.clip:
        before = command[2:].copy()
        command[2] = _clip(command[2], SPEED_LIMIT_M_S)
        command[3] = _clip(command[3], YAW_RATE_LIMIT_RAD_S)
        if report[PACE] < 1.0 or command[2] != before[0] or command[3] != before[1]:
            report[_CLIP] += 1.0
    if tuning.finite and not np.isfinite(command).all():
        report[_FINITE] += 1.0
        for axis in range(4):
            command[axis] = command[axis] if math.isfinite(command[axis]) else 0.0
    return command


@njit(cache=True)
def held_state(trajectory: NDArray[np.float64]) -> NDArray[np.float64]:
    """The state (11,) that a trajectory's first row asks for: as :func:`state_at`, without a yaw rate."""
    state = np.zeros(11)
    state[:10] = trajectory[0, 1:11]
    return state


@njit(cache=True)
def state_at(trajectory: NDArray[np.float64], now_s: float) -> NDArray[np.float64]:
    """Position, velocity, acceleration, yaw and yaw rate (11,) at ``now_s``; at rest before and after.

    Between two rows the position is the quintic that has the position, velocity and acceleration of
    both: as smooth as the curve that the rows were taken from.
    """
    state = np.zeros(11)
    last = len(trajectory) - 1
    if not trajectory[0, 0] <= now_s < trajectory[last, 0]:
        row = trajectory[last] if now_s >= trajectory[last, 0] else trajectory[0]
        state[:3] = row[1:4]
        state[9] = row[10]
        return state
    index = min(max(int(np.searchsorted(trajectory[:, 0], now_s, side="right")), 1), last)
    a, b = trajectory[index - 1], trajectory[index]
    duration = b[0] - a[0]
    if not duration > 0.0:
        state[:10] = a[1:11]
        return state
    s = (now_s - a[0]) / duration
    for axis in range(3):
        p, v, c = a[1 + axis], a[4 + axis] * duration, a[7 + axis] * duration**2
        rest = b[1 + axis] - p - v - 0.5 * c
        rest_v = b[4 + axis] * duration - v - c
        rest_c = b[7 + axis] * duration**2 - c
        k3 = 10.0 * rest - 4.0 * rest_v + 0.5 * rest_c
        k4 = -15.0 * rest + 7.0 * rest_v - rest_c
        k5 = 6.0 * rest - 3.0 * rest_v + 0.5 * rest_c
        state[axis] = p + s * (v + s * (0.5 * c + s * (k3 + s * (k4 + s * k5))))
        state[3 + axis] = (v + s * (c + s * (3.0 * k3 + s * (4.0 * k4 + s * 5.0 * k5)))) / duration
        state[6 + axis] = (c + s * (6.0 * k3 + s * (12.0 * k4 + s * 20.0 * k5))) / duration**2
    turn = _shortest_turn(a[10], b[10])
    state[9] = a[10] + s * turn
    state[10] = turn / duration
    return state


@njit(cache=True)
def stopping(
    now_s: float,
    position: NDArray[np.float64],
    velocity: NDArray[np.float64],
    yaw: float,
    deceleration_m_s2: float,
) -> NDArray[np.float64]:
    """Trajectory (2, 12) from the present state to rest, straight on at a constant deceleration."""
    rows = np.zeros((2, 12))
    speed = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    duration = speed / deceleration_m_s2
    rows[0, 0], rows[1, 0] = now_s, now_s + duration
    rows[:, 10] = yaw
    for axis in range(3):
        rows[0, 1 + axis] = position[axis]
        rows[1, 1 + axis] = position[axis] + 0.5 * duration * velocity[axis]
        rows[0, 4 + axis] = velocity[axis]
        if speed > 0.0:
            rows[:, 7 + axis] = -deceleration_m_s2 * velocity[axis] / speed
    return rows


@njit(cache=True)
def _believed(value: float, limit: float, tuning: Tuning, report: NDArray[np.float64]) -> float:
    """``value`` as far as the guards let it be believed: zero if it is not finite, within +-``limit``."""
    if tuning.finite and not math.isfinite(value):
        report[_FINITE] += 1.0
        return 0.0
    if tuning.limits and abs(value) > limit:
        report[_LIMITS] += 1.0
        return _clip(value, limit)
    return value


@njit(cache=True)
def _clip(value: float, limit: float) -> float:
    """``value`` within +-``limit``; what is not a number stays so."""
    if value > limit:
        return limit
    return -limit if value < -limit else value


@njit(cache=True)
def _shortest_turn(start: float, end: float) -> float:
    """The angle from ``start`` to ``end`` in [-pi, pi)."""
    return (end - start + math.pi) % (2.0 * math.pi) - math.pi
