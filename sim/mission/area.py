"""The area of a mission: its corners, its cells, and what of them has been covered."""

from __future__ import annotations

from math import hypot, radians, tan

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.models.equipment import Camera
from services.models.mission import Area
from sim.vehicle.vehicle import Floats, Vehicle
from sim.world import BadWorldError, World

DEFAULT_SIDE_M = 24.0
"""Shortest side of an area that nobody stated: three swaths of 8 m."""

CELL_M = 1.0


def corners(stated: Area, world: World) -> Floats:
    """Lower and upper corner (2, 3) of a mission's area, at the height of the world's start.

    By default it holds start and goal; a side that is too short then grows to where there is more room.

    :raises BadWorldError: if the area is empty, reaches beyond the world, or holds obstacles only.
    """
    ends = np.array([world.start[:2], world.goal[:2]])
    lower, upper = ends.min(axis=0), ends.max(axis=0)
    for axis in (0, 1):
        missing = max(DEFAULT_SIDE_M - (upper[axis] - lower[axis]), 0.0)
        below, above = lower[axis] - world.bounds[0, axis], world.bounds[1, axis] - upper[axis]
        if below >= above:
            lower[axis] -= min(missing, below)
        else:
            upper[axis] += min(missing, above)
    lower = lower if stated.lower is None else np.array(stated.lower)
    upper = upper if stated.upper is None else np.array(stated.upper)
    within = (world.bounds[0, :2] <= lower).all() and (upper <= world.bounds[1, :2]).all()
    area = np.array([[*lower, world.start[2]], [*upper, world.start[2]]])
    if not (lower < upper).all() or not within or not len(cells(area, world.obstacles)):
        message = (
            f"area: lower {lower.tolist()}, upper {upper.tolist()} is no free part of the world"
            f" {world.bounds[0, :2].tolist()} to {world.bounds[1, :2].tolist()}"
        )
        raise BadWorldError(message)
    return area


def cells(area: Floats, obstacles: Floats, margin_m: float = 0.0) -> Floats:
    """Centres (n, 3) of the area's cells that lie ``margin_m`` clear of the boxes (m, 6)."""
    sides = area[1, :2] - area[0, :2]
    counts = np.maximum(np.round(sides / CELL_M), 1.0)
    x, y = (area[0, axis] + (np.arange(counts[axis]) + 0.5) * (sides / counts)[axis] for axis in (0, 1))
    level = np.meshgrid(x, y, area[0, 2], indexing="ij")
    centres = np.stack(level, axis=-1).reshape(-1, 3)
    inside = np.zeros(len(centres), dtype=np.bool_)
    for box in obstacles:
        inside |= ((box[:3] - margin_m < centres) & (centres < box[3:] + margin_m)).all(axis=1)
    return np.ascontiguousarray(centres[~inside])


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
