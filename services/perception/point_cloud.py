"""Kernel: depth image to point cloud in the world frame."""

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
    depth: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    position: NDArray[np.float64],
    orientation: NDArray[np.float64],
    max_range_m: float,
) -> NDArray[np.float32]:
    """Points of a depth image, world frame, float32 (n, 3), row by row of the image.

    ``depth`` (h, w) holds the distance along the optical axis in m (z-depth), ``inf`` for no return.
    The pinhole (fx, fy, cx, cy, in pixels) sits at the body's origin and looks along body x; the pixel
    in row v, column u sees the direction (1, -(u - cx) / fx, -(v - cy) / fy) of the body frame.
    ``position`` (3,) and ``orientation`` (w, x, y, z) take the body frame to the world frame.

    A ray that meets nothing within ``max_range_m`` ends ``MISS_MARGIN_M`` beyond it: a map that cuts
    rays at the range clears free space with it and marks no obstacle. Pixels that are NaN, zero or
    negative are no measurement and give no point.
    """
    height, width = depth.shape
    w, x, y, z = orientation[0], orientation[1], orientation[2], orientation[3]
    forward = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y))
    left = (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x))
    up = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
    points = np.empty((height * width, 3), dtype=np.float32)
    count = 0
    for v in range(height):
        lift = -(v - cy) / fy
        for u in range(width):
            measured = depth[v, u]
            if not measured > 0.0:
                continue
            side = -(u - cx) / fx
            stretch = math.sqrt(1.0 + side * side + lift * lift)
            scale = float(measured)
            if scale * stretch > max_range_m:
                scale = (max_range_m + MISS_MARGIN_M) / stretch
            for axis in range(3):
                ray = forward[axis] + side * left[axis] + lift * up[axis]
                points[count, axis] = position[axis] + scale * ray
            count += 1
    return points[:count]
