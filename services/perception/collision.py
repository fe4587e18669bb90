"""Kernel: collision check, the safety body swept along the rest of the trajectory."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.models.safety import BODY_HEIGHT_M, BODY_RADIUS_M
from services.perception.occupancy import OccupancyMap

_MAX_VOXELS = 20_000
"""Where a sweep ends that no sensible trajectory asks for: 400 m of flight."""

_COUNTER_MAX = 2**32 - 1


def time_to_collision(
    trajectory: NDArray[np.float64],
    now_s: float,
    occupancy: OccupancyMap,
    radius_m: float = BODY_RADIUS_M,
    height_m: float = BODY_HEIGHT_M,
) -> float:
    """Seconds from ``now_s`` until the safety body first enters an occupied voxel, or ``inf``.

    ``trajectory`` (n, 12) as it stands on the bus, time in its first column, position in the next
    three. What the body holds already at ``now_s`` does not count, or a vehicle that came too close
    could never leave.
    """
    centres, times = swept_voxels(trajectory, now_s, occupancy.resolution_m, radius_m, height_m)
    struck = occupancy.occupied(centres)
    if not struck.any():
        return math.inf
    return float(times[struck.argmax()] - now_s)


class CollisionCounter:
    """Counts newly found collisions: ``future_collision_seq``.

    A collision is new if the frame before had found none on the same trajectory.
    """

    def __init__(self) -> None:
        self.future_collision_seq = 0
        self._known: int | None = None

    def update(self, trajectory_seq: int, answered: int, *, collision: bool) -> int:
        """The counter after this frame's verdict on trajectory ``trajectory_seq``.

        ``answered`` is the count that the trajectory was planned for: a perception stage that was
        restarted goes on from there.
        """
        self.future_collision_seq = max(self.future_collision_seq, answered)
        if not collision:
            self._known = None
        elif self._known != trajectory_seq:
            self._known = trajectory_seq
            self.future_collision_seq = min(self.future_collision_seq + 1, _COUNTER_MAX)
        return self.future_collision_seq


@njit(cache=True)
def swept_voxels(
    trajectory: NDArray[np.float64], now_s: float, resolution_m: float, radius_m: float, height_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Voxels that the body newly enters from ``now_s`` on, in order: centres (m, 3) and times (m,).

    A voxel is in the body if its centre is within ``radius_m`` horizontally and the voxel overlaps the
    height. The body is set down every half voxel along the trajectory.
    """
    centres = np.empty((_MAX_VOXELS, 3))
    times = np.empty(_MAX_VOXELS)
    count = 0
    body = np.empty(3)
    before = np.full(3, np.nan)
    reach = 0.5 * (height_m + resolution_m)
    for row in range(len(trajectory) - 1):
        t0, t1 = trajectory[row, 0], trajectory[row + 1, 0]
        if t1 <= now_s:
            continue
        a, b = trajectory[row, 1:4], trajectory[row + 1, 1:4]
        length = math.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
        if not length < _MAX_VOXELS * resolution_m:
            break
        begin = (now_s - t0) / (t1 - t0) if t0 < now_s else 0.0
        steps = int(2.0 * length / resolution_m) + 1
        for step in range(steps + 1):
            s = begin + (1.0 - begin) * step / steps
            for axis in range(3):
                body[axis] = a[axis] + s * (b[axis] - a[axis])
            t = t0 + s * (t1 - t0)
            count = _enter(body, before, resolution_m, radius_m, reach, t, centres, times, count)
            before[:] = body
    return centres[:count], times[:count]


@njit(cache=True)
def _enter(
    body: NDArray[np.float64],
    before: NDArray[np.float64],
    resolution: float,
    radius: float,
    reach: float,
    t: float,
    centres: NDArray[np.float64],
    times: NDArray[np.float64],
    count: int,
) -> int:
    """Append the voxels in the body at ``body`` that were not in it at ``before`` (NaN: the start)."""
    if math.isnan(before[0]):
        return count
    for i in range(math.floor((body[0] - radius) / resolution), math.ceil((body[0] + radius) / resolution)):
        x = (i + 0.5) * resolution
        for j in range(
            math.floor((body[1] - radius) / resolution), math.ceil((body[1] + radius) / resolution)
        ):
            y = (j + 0.5) * resolution
            if (x - body[0]) ** 2 + (y - body[1]) ** 2 > radius**2:
                continue
            was_near = (x - before[0]) ** 2 + (y - before[1]) ** 2 <= radius**2
            for k in range(
                math.floor((body[2] - reach) / resolution), math.ceil((body[2] + reach) / resolution)
            ):
                z = (k + 0.5) * resolution
                if abs(z - body[2]) > reach or (was_near and abs(z - before[2]) <= reach):
                    continue
                if count == len(times):
                    return count
                centres[count] = (x, y, z)
                times[count] = t
                count += 1
    return count
