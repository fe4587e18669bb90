"""The depth camera: one ray per pixel into the world, without a GPU or a display."""

from __future__ import annotations

from math import radians, tan

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.vehicle import Vehicle


class DepthCamera:
    """A pinhole depth camera in the centre of the body, looking forward.

    Pixel (row v, column u) looks along ((u - cx) / fx, (v - cy) / fy, 1) of the optical frame
    (x right, y down, z forward: REP 103), so rows run downwards and columns to the right. The default
    keeps the authors' field of view and aspect ratio at a quarter of their 256 x 144 pixels a side
    (facts page, "depth camera"): neighbouring rays are 0.2 m apart at their mapping range of 7 m.
    """

    def __init__(
        self, width: int = 64, height: int = 36, fov_rad: float = radians(90.0), range_m: float = 20.0
    ) -> None:
        self.width, self.height, self.range_m = width, height, range_m
        self.fx = self.fy = width / 2 / tan(fov_rad / 2)
        self.cx, self.cy = (width - 1) / 2, (height - 1) / 2
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        # In the body frame, with a forward part of one: distances along these rays are depths.
        self._rays = np.stack(
            [np.ones(u.shape), -(u - self.cx) / self.fx, -(v - self.cy) / self.fy], axis=-1
        ).reshape(-1, 3)
        self._farthest_m = range_m * float(np.linalg.norm(self._rays, axis=1).max())
        self._geom = np.empty(width * height, np.int32)
        self._depth = np.empty(width * height)

    def render(self, vehicle: Vehicle) -> NDArray[np.float32]:
        """Depth along the optical axis in m, float32 (height, width); obstacles and ground are seen.

        As REP 118 has it, +inf means nothing within range.
        """
        mujoco.mj_multiRay(
            vehicle.model,
            vehicle.data,
            vehicle.position,
            (self._rays @ vehicle.rotation.T).ravel(),
            None,
            True,
            vehicle.hull,
            self._geom,
            self._depth,
            None,
            len(self._depth),
            self._farthest_m,
        )
        missed = (self._geom < 0) | (self._depth > self.range_m)
        image = np.where(missed, np.inf, self._depth).astype(np.float32)
        return image.reshape(self.height, self.width)
