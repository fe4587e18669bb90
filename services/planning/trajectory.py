"""Kernel: time-parameterised trajectory along a path."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.models.safety import SPEED_LIMIT_M_S
from services.planning.polyline import subdivide
from services.planning.spline import excess, minimum_snap, sample
from services.planning.voxels import CLOSE, NEAR, OCCUPIED, VoxelGrid, edge_clear, level_at

ACCELERATION_LIMIT_M_S2 = 5.0
MIDPOINTS_MAX = 40
"""Insertions after which smoothing gives up. Both: facts page, "smoothing"."""

STEP_S = 0.25
"""Between points. The authors' 0.5 s let a chord of a turn stray 0.2 m from the curve."""

HELD_STEP_S = 0.5
"""Between points without the guard ``dense``: facts page, "smoothing"."""

YAW_RATE_LIMIT_RAD_S = math.radians(75.0)
"""Below the 90 deg/s that control allows, so that control can catch up."""

_CRUISE = 0.95  # of the speed limit, what the spline overshoots by is left free
_PACE_M_S2 = 2.0  # acceleration of the first guess at the timing
_LEG_M = 3.0  # longest distance between waypoints of the spline
_CORNER_SPEED = 0.15  # of cruise, where the path turns back on itself
_CHECK_S = 0.025  # so fine that nothing exceeds a limit between two checks
_STRETCHES_MAX = 8
_SLOWEST = 3.0  # times the first guess; a start that leads away from the path only gets worse with time
_STRETCH_TOLERANCE = 1.01  # in time, so 1.01 in speed and 1.01^2 in acceleration
_AIM = 0.98  # of the limits: what departs from such a trajectory stays below them, too
_TURN_FIRST_RAD = math.radians(35.0)  # beyond this off the nose, the camera would not see the way
_SOME_WAY_M = 2.0
_STANDING_M_S = 0.3
_LOOK_AHEAD_S = 1.0  # the camera must have seen a bend before the vehicle is in it


@dataclass(frozen=True, slots=True)
class Departure:
    """The state from which a trajectory starts, world frame; ``time_s`` is virtual time."""

    time_s: float
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    yaw: float


def trajectory(
    path: NDArray[np.float64],
    departure: Departure,
    grid: VoxelGrid,
    limit: int = NEAR,
    speed_limit_m_s: float = SPEED_LIMIT_M_S,
    acceleration_limit_m_s2: float = ACCELERATION_LIMIT_M_S2,
    step_s: float = STEP_S,
) -> NDArray[np.float64] | None:
    """Trajectory (n, 12) along ``path`` (m, 3): t, x y z, vx vy vz, ax ay az, yaw, blocking_yaw.

    World frame, SI units, virtual time, ``step_s`` or a little less from point to point. Starts at
    ``departure``, ends at rest at the path's last point, keeps the limits of speed and acceleration and
    lets the safety body touch nothing that ``grid`` knows. The nose points along the motion; a vehicle
    that stands first turns on the spot, and these points have ``blocking_yaw`` set. ``limit`` is the
    level that the path keeps out of. None if no curve along the path keeps the limits and its distance.
    """
    turn_s = _first_turn(path, departure)
    smooth = _smooth(path, departure, grid, limit, speed_limit_m_s, acceleration_limit_m_s2)
    if smooth is None:
        return None
    coefficients, durations = smooth
    flight_s = float(durations.sum())
    times = np.linspace(0.0, flight_s, math.ceil(flight_s / step_s) + 1)
    motion = sample(coefficients, durations, times)
    turning = math.ceil(turn_s / step_s)
    rows = np.zeros((turning + len(times), 12))
    rows[:, 0] = departure.time_s + np.concatenate((np.arange(turning) * step_s, turning * step_s + times))
    rows[:turning, 1:4] = departure.position
    rows[turning:, 1:10] = motion
    rows[:, 10] = _headings(rows, turning, departure.yaw, _heading_of(path, departure.yaw), step_s)
    rows[:turning, 11] = 1.0
    return rows


def _smooth(
    path: NDArray[np.float64],
    departure: Departure,
    grid: VoxelGrid,
    limit: int,
    speed_limit: float,
    acceleration_limit: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Minimum-snap spline within the limits and clear of obstacles: coefficients, durations.

    Where it collides, the middle of the waypoints on either side becomes a waypoint (Richter, Bry and
    Roy 2016): the spline tends to the path, which is free.
    """
    waypoints = subdivide(path if len(path) > 1 else np.repeat(path, 2, axis=0), _LEG_M)
    waypoints[0] = departure.position
    speed_limit = max(_AIM * speed_limit, float(np.linalg.norm(departure.velocity)))
    acceleration_limit *= _AIM
    for _ in range(MIDPOINTS_MAX + 1):
        pace_m_s2 = min(_PACE_M_S2, acceleration_limit)
        durations = _pace(waypoints, departure.velocity, _CRUISE * speed_limit, pace_m_s2)
        first_guess_s = durations.sum()
        for _ in range(_STRETCHES_MAX):
            coefficients = minimum_snap(waypoints, durations, departure.velocity, departure.acceleration)
            times = np.arange(0.0, durations.sum() + _CHECK_S, _CHECK_S)
            motion = sample(coefficients, durations, times)
            factors = excess(motion, times, durations, speed_limit, acceleration_limit)
            if factors.max() <= _STRETCH_TOLERANCE:
                break
            durations = durations * factors
            if durations.sum() > _SLOWEST * first_guess_s:
                return None
        else:
            return None
        struck_s = _first_contact(motion, times, grid.levels, grid.origin, grid.resolution_m, limit)
        if struck_s < 0.0:
            return coefficients, durations
        segment = min(int(np.searchsorted(durations.cumsum(), struck_s)), len(durations) - 1)
        middle = 0.5 * (waypoints[segment] + waypoints[segment + 1])
        waypoints = np.insert(waypoints, segment + 1, middle, axis=0)
    return None


@njit(cache=True)
def _pace(
    waypoints: NDArray[np.float64], velocity: NDArray[np.float64], cruise: float, acceleration: float
) -> NDArray[np.float64]:
    """First guess at the time for each leg: trapezoidal speed, slower at corners, at rest at the end."""
    legs = len(waypoints) - 1
    lengths = np.empty(legs)
    speeds = np.zeros(legs + 1)
    for leg in range(legs):
        lengths[leg] = max(math.sqrt(np.sum((waypoints[leg + 1] - waypoints[leg]) ** 2)), 1e-3)
    ahead = (waypoints[1] - waypoints[0]) / lengths[0]
    speeds[0] = min(max(np.sum(velocity * ahead), 0.0), cruise)
    for leg in range(1, legs):
        before = (waypoints[leg] - waypoints[leg - 1]) / lengths[leg - 1]
        after = (waypoints[leg + 1] - waypoints[leg]) / lengths[leg]
        straightness = 0.5 * (1.0 + np.sum(before * after))
        speeds[leg] = cruise * max(straightness, _CORNER_SPEED)
    for leg in range(legs):
        speeds[leg + 1] = min(
            speeds[leg + 1], math.sqrt(speeds[leg] ** 2 + 2.0 * acceleration * lengths[leg])
        )
    for leg in range(legs - 1, 0, -1):
        speeds[leg] = min(speeds[leg], math.sqrt(speeds[leg + 1] ** 2 + 2.0 * acceleration * lengths[leg]))
    durations = np.empty(legs)
    for leg in range(legs):
        a, b = speeds[leg], speeds[leg + 1]
        top = min(math.sqrt(0.5 * (a * a + b * b) + acceleration * lengths[leg]), cruise)
        rising, falling = max(top - a, 0.0), max(top - b, 0.0)
        sloped = rising * (top + a) + falling * (top + b)
        even = max(lengths[leg] - sloped / (2.0 * acceleration), 0.0)
        durations[leg] = (rising + falling) / acceleration + even / top
    return durations


@njit(cache=True)
def _first_contact(
    motion: NDArray[np.float64],
    times: NDArray[np.float64],
    levels: NDArray[np.uint8],
    origin: NDArray[np.float64],
    resolution: float,
    limit: int,
) -> float:
    """Time at which the curve first comes too close to an obstacle, or -1.

    A start that is too close already may be left: up to the first voxel below ``limit`` only what
    is occupied counts, and not that if the start itself lies in it.
    """
    begin = motion[0]
    inside = level_at(levels, origin, resolution, begin[0], begin[1], begin[2]) == OCCUPIED
    left = False
    for index in range(len(motion) - 1):
        a, b = motion[index], motion[index + 1]
        left = left or level_at(levels, origin, resolution, a[0], a[1], a[2]) < limit
        wall = CLOSE if left else OCCUPIED
        if inside and not left:
            continue
        if not edge_clear(levels, origin, resolution, a[0], a[1], a[2], b[0], b[1], b[2], wall):
            return float(times[index])
    return -1.0


def _heading_of(path: NDArray[np.float64], otherwise: float) -> float:
    """Direction of the path's first corner that is some way off, past any step out of a tight spot."""
    for corner in path[1:] - path[0]:
        if math.hypot(corner[0], corner[1]) > _SOME_WAY_M:
            return math.atan2(corner[1], corner[0])
    return otherwise


def _first_turn(path: NDArray[np.float64], departure: Departure) -> float:
    """Seconds to turn on the spot before departing; none for a vehicle in motion."""
    if np.linalg.norm(departure.velocity) > _STANDING_M_S:
        return 0.0
    off = abs(math.remainder(_heading_of(path, departure.yaw) - departure.yaw, math.tau))
    return off / YAW_RATE_LIMIT_RAD_S if off > _TURN_FIRST_RAD else 0.0


@njit(cache=True)
def _headings(
    rows: NDArray[np.float64], turning: int, yaw: float, first_heading: float, step_s: float
) -> NDArray[np.float64]:
    """Yaw of each row: towards where the vehicle will be in ``_LOOK_AHEAD_S``, within the yaw rate.

    The first ``turning`` rows turn in place.
    """
    headings = np.empty(len(rows))
    wanted = first_heading if turning else yaw
    ahead = round(_LOOK_AHEAD_S / step_s)
    for index in range(len(rows)):
        if index >= turning:
            there = rows[min(index + ahead, len(rows) - 1)]
            dx, dy = there[1] - rows[index, 1], there[2] - rows[index, 2]
            if math.hypot(dx, dy) > _STANDING_M_S * _LOOK_AHEAD_S:
                wanted = math.atan2(dy, dx)
        if index:
            most = YAW_RATE_LIMIT_RAD_S * (rows[index, 0] - rows[index - 1, 0])
            off = (wanted - yaw + math.pi) % (2.0 * math.pi) - math.pi
            yaw += min(max(off, -most), most)
        headings[index] = (yaw + math.pi) % (2.0 * math.pi) - math.pi
    return headings
