"""What of a mission's area has been covered: flown over, or seen by the camera."""

from __future__ import annotations

from math import hypot, radians, tan

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.models.equipment import Camera
from sim.vehicle.vehicle import Floats, Vehicle


class CameraView:
    """What the camera has in view: within its image and ``range_m``, and not behind an obstacle."""

    def __init__(self, camera: Camera, range_m: float, obstacles: Floats) -> None:
        self._tangent = tan(radians(camera.fov_deg) / 2)
        self._tangents = (self._tangent, self._tangent * camera.height / camera.width)
        self._range_m = range_m
        self._obstacles = obstacles

    def mark(self, vehicle: Vehicle, points: Floats, seen: NDArray[np.bool_]) -> None:
        """Set ``seen`` (n,) for those of ``points`` (n, 3) that are in view now."""
        eye, rotation = vehicle.position, np.ascontiguousarray(vehicle.rotation)
        _mark_in_view(points, seen, eye, rotation, self._tangents, self._range_m, self._obstacles)


@njit(cache=True)
def mark_overflown(points: Floats, covered: NDArray[np.bool_], position: Floats, half_swath_m: float) -> None:
    """Set ``covered`` (n,) for those of ``points`` (n, 3) that lie within half a swath of ``position``."""
    for i in range(len(points)):
        if hypot(points[i, 0] - position[0], points[i, 1] - position[1]) <= half_swath_m:
            covered[i] = True


@njit(cache=True)
def _mark_in_view(
    points: Floats,
    seen: NDArray[np.bool_],
    eye: Floats,
    rotation: Floats,
    tangents: tuple[float, float],
    range_m: float,
    obstacles: Floats,
) -> None:
    """``rotation`` (3, 3) takes the body frame, x forward, to the world frame."""
    for i in range(len(points)):
        if seen[i]:
            continue
        ray = points[i] - eye
        if np.sum(ray * ray) > range_m * range_m:
            continue
        ahead, left, up = (
            np.sum(ray * rotation[:, 0]),
            np.sum(ray * rotation[:, 1]),
            np.sum(ray * rotation[:, 2]),
        )
        if ahead <= 0.0 or abs(left) > tangents[0] * ahead or abs(up) > tangents[1] * ahead:
            continue
        seen[i] = not _hidden(obstacles, eye, ray)


@njit(cache=True)
def _hidden(obstacles: Floats, eye: Floats, ray: Floats) -> bool:
    """Whether one of the boxes (n, 6) stands between ``eye`` and ``eye + ray``."""
    for box in obstacles:
        enter, leave = 0.0, 1.0
        for axis in range(3):
            low, high = box[axis] - eye[axis], box[axis + 3] - eye[axis]
            if ray[axis] == 0.0:
                if low > 0.0 or high < 0.0:
                    leave = -1.0
                continue
            first, second = low / ray[axis], high / ray[axis]
            enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
        if enter <= leave:
            return True
    return False
