"""The map as planning uses it: an OctoMap message unpacked into a dense grid of clearance levels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.bus.octomaps import SEEN_OCCUPIED, UNKNOWN, known
from services.models.safety import BODY_RADIUS_M

# Levels of a voxel, each implying those before it.
FREE = 0
NEAR = 1  # an obstacle is within the clearance, or may hide here: paths keep out
CLOSE = 2  # the safety body may touch an obstacle: trajectories keep out
OCCUPIED = 3

CLEARANCE_M = 2.25
"""Between a path and the centre of an occupied voxel. The authors' 2 m and half a voxel."""

HIDDEN_M = 3.5
"""Unknown space this near to an occupied voxel is probably the inside of the obstacle or what it hides.
A path that cuts closely behind a corner would meet it too late to stop."""


@dataclass(frozen=True, slots=True)
class VoxelGrid:
    """Clearance levels of the voxels in a box.

    ``levels`` (nx, ny, nz) uint8; voxel (0, 0, 0) has its lower corner at ``origin`` (3,), world frame.
    """

    levels: NDArray[np.uint8]
    origin: NDArray[np.float64]
    resolution_m: float

    def level(self, point: NDArray[np.float64]) -> int:
        """Level of the voxel at ``point`` (3,); outside the grid everything is occupied."""
        return int(level_at(self.levels, self.origin, self.resolution_m, point[0], point[1], point[2]))

    def edge_clear(self, a: NDArray[np.float64], b: NDArray[np.float64], limit: int = NEAR) -> bool:
        """Whether every voxel on the straight line from ``a`` to ``b`` is below ``limit``."""
        ends = (a[0], a[1], a[2], b[0], b[1], b[2])
        return bool(edge_clear(self.levels, self.origin, self.resolution_m, *ends, limit))


def unpack(
    payload: bytes,
    resolution_m: float,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    clearance_m: float = CLEARANCE_M,
    body_radius_m: float = BODY_RADIUS_M,
) -> VoxelGrid:
    """The box from ``low`` to ``high`` (3,) of the map in an ``octomap_msgs/Octomap`` message's data.

    Around each occupied voxel the levels fall off with the horizontal distance; above and below, one
    voxel's height is kept. Unknown space is free, unless it is close behind something.

    :raises MalformedMap: if the data breaks off, goes on after the tree or branches too deep, or if the box
        is absurdly large.
    """
    margin = math.ceil(max(clearance_m, HIDDEN_M) / resolution_m)
    seen = known(payload, resolution_m, low, high, margin)
    first = np.floor(low / resolution_m).astype(np.int64)
    # A position is up to half a diagonal off its voxel's centre.
    close_m = body_radius_m + resolution_m / math.sqrt(2.0)
    radii = np.array([clearance_m, close_m, HIDDEN_M]) / resolution_m
    origin = first.astype(np.float64) * resolution_m
    return VoxelGrid(_levels(seen, margin, radii), origin, resolution_m)


@njit(cache=True)
def _levels(seen: NDArray[np.uint8], margin: int, radii: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Levels of the grid without its margin. ``radii`` in voxels: clearance, body, hidden space."""
    nx, ny, nz = seen.shape
    levels = np.zeros((nx, ny, nz), dtype=np.uint8)
    near, close, hidden = radii
    for i, j, k in np.argwhere(seen == SEEN_OCCUPIED):
        top = _end_of_wall(seen, i, j, k, 1, hidden)
        bottom = _end_of_wall(seen, i, j, k, -1, hidden)
        for ii in range(max(i - margin, 0), min(i + margin + 1, nx)):
            for jj in range(max(j - margin, 0), min(j + margin + 1, ny)):
                distance = math.sqrt((ii - i) ** 2 + (jj - j) ** 2)
                if distance <= near:
                    level = CLOSE if distance <= close else NEAR
                    for kk in range(max(k - 1, 0), min(k + 2, nz)):
                        levels[ii, jj, kk] = max(levels[ii, jj, kk], level)
                if distance <= hidden:
                    for kk in range(bottom, top + 1):
                        if seen[ii, jj, kk] == UNKNOWN:
                            levels[ii, jj, kk] = max(levels[ii, jj, kk], NEAR)
        levels[i, j, k] = OCCUPIED
    return levels[margin : nx - margin, margin : ny - margin, margin : nz - margin].copy()


@njit(cache=True)
def _end_of_wall(seen: NDArray[np.uint8], i: int, j: int, k: int, step: int, hidden: float) -> int:
    """How far up (``step`` 1) or down (-1) something may hide around an occupied voxel.

    What stands at least two voxels high probably goes on where it was not seen to end.
    """
    nz = int(seen.shape[2])
    ahead, behind = k + step, k - step
    if not (0 <= ahead < nz and 0 <= behind < nz):
        return k
    if seen[i, j, behind] != SEEN_OCCUPIED or seen[i, j, ahead] != UNKNOWN:
        return k
    return min(max(k + step * int(hidden), 0), nz - 1)


@njit(cache=True)
def level_at(
    levels: NDArray[np.uint8], origin: NDArray[np.float64], resolution: float, x: float, y: float, z: float
) -> int:
    """Level of the voxel at a point; outside the grid everything is occupied."""
    nx, ny, nz = levels.shape
    i = math.floor((x - origin[0]) / resolution)
    j = math.floor((y - origin[1]) / resolution)
    k = math.floor((z - origin[2]) / resolution)
    if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
        return int(levels[i, j, k])
    return OCCUPIED


@njit(cache=True)
def edge_clear(
    levels: NDArray[np.uint8],
    origin: NDArray[np.float64],
    resolution: float,
    ax: float,
    ay: float,
    az: float,
    bx: float,
    by: float,
    bz: float,
    limit: int,
) -> bool:
    """Whether every voxel on the line from a to b is inside the grid and below ``limit``.

    Walks from voxel face to voxel face (Amanatides and Woo 1987).
    """
    a = ((ax - origin[0]) / resolution, (ay - origin[1]) / resolution, (az - origin[2]) / resolution)
    b = ((bx - origin[0]) / resolution, (by - origin[1]) / resolution, (bz - origin[2]) / resolution)
    voxel = np.empty(3, dtype=np.int64)
    step = np.empty(3, dtype=np.int64)
    to_face = np.empty(3)  # fraction of the edge up to the next face
    per_voxel = np.empty(3)
    faces = 0
    for axis in range(3):
        if not (0.0 <= a[axis] < levels.shape[axis] and 0.0 <= b[axis] < levels.shape[axis]):
            return False
        delta = b[axis] - a[axis]
        voxel[axis] = math.floor(a[axis])
        faces += abs(math.floor(b[axis]) - voxel[axis])
        step[axis] = 1 if delta > 0.0 else -1
        per_voxel[axis] = abs(1.0 / delta) if delta != 0.0 else math.inf
        ahead = voxel[axis] + 1 - a[axis] if delta > 0.0 else a[axis] - voxel[axis]
        to_face[axis] = ahead * per_voxel[axis] if delta != 0.0 else math.inf
    for _ in range(faces):
        if levels[voxel[0], voxel[1], voxel[2]] >= limit:
            return False
        axis = 0 if to_face[0] <= to_face[1] else 1
        axis = axis if to_face[axis] <= to_face[2] else 2
        voxel[axis] += step[axis]
        to_face[axis] += per_voxel[axis]
        if not 0 <= voxel[axis] < levels.shape[axis]:
            return False
    return bool(levels[voxel[0], voxel[1], voxel[2]] < limit)
