"""Kernel: depth image to point cloud in the camera's optical frame."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

MISS_MARGIN_M = 1.0
"""How far beyond the range a ray without a return ends: more than half the diagonal of any voxel in
use, so that no rounding to a voxel brings the end of a miss back into the range."""


@njit(cache=True)
def point_cloud(
    depth: NDArray[np.float32], fx: float, fy: float, cx: float, cy: float, max_range_m: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points of a depth image, and the ends of its rays that met nothing.

    Both are float32 (n, 3), m, in the camera's optical frame (x right, y down, z forward: REP 103), row by
    row of the image. ``depth`` (h, w) holds the distance along the optical axis in m (z-depth), ``inf`` for
    no return. The pinhole is (fx, fy, cx, cy) in pixels; the pixel in row v, column u sees the direction
    ((u - cx) / fx, (v - cy) / fy, 1).

    A ray that meets nothing within ``max_range_m`` ends ``MISS_MARGIN_M`` beyond it: a map that cuts
    rays at the range clears free space with it and marks no obstacle. Pixels that are NaN, zero or
    negative are no measurement and give neither.
    """
    height, width = depth.shape
    points = np.empty((height * width, 3), dtype=np.float32)
    misses = np.empty((height * width, 3), dtype=np.float32)
    met = missed = 0
    for v in range(height):
        down = (v - cy) / fy
        for u in range(width):
            measured = float(depth[v, u])
            if not measured > 0.0:
                continue
            right = (u - cx) / fx
            stretch = math.sqrt(1.0 + right * right + down * down)
            if measured * stretch > max_range_m:
                z = (max_range_m + MISS_MARGIN_M) / stretch
                misses[missed, 0], misses[missed, 1], misses[missed, 2] = z * right, z * down, z
                missed += 1
            else:
                points[met, 0], points[met, 1] = measured * right, measured * down
                points[met, 2] = measured
                met += 1
    return points[:met], misses[:missed]


@njit(cache=True)
def in_world(
    points: NDArray[np.float32],
    misses: NDArray[np.float32],
    position: NDArray[np.float64],
    attitude: NDArray[np.float64],
) -> NDArray[np.float64]:
    """What :func:`point_cloud` returned, points, then misses, as one float64 array (n, 3), world frame, m.

    The camera is at ``position`` (3,) and looks along the x axis of the body, which the unit quaternion
    ``attitude`` (w, x, y, z) takes to the world frame.
    """
    w, x, y, z = attitude[0], attitude[1], attitude[2], attitude[3]
    forward = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y))
    left = (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x))
    up = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
    met = len(points)
    scan = np.empty((met + len(misses), 3))
    for index in range(len(scan)):
        end = points[index] if index < met else misses[index - met]
        for axis in range(3):
            turned = end[2] * forward[axis] - end[0] * left[axis] - end[1] * up[axis]
            scan[index, axis] = position[axis] + turned
    return scan
