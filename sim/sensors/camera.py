"""The depth camera: one ray per pixel into the world, without a GPU or a display."""

from __future__ import annotations

from math import radians, tan

import mujoco
import numpy as np
from numpy.typing import NDArray

from services.models.equipment import Camera
from services.runtime.rng import generator
from sim.vehicle.vehicle import Vehicle


class DepthCamera:
    """A pinhole depth camera in the centre of the body, looking forward.

    Pixel (row v, column u) looks along ((u - cx) / fx, (v - cy) / fy, 1) of the optical frame
    (x right, y down, z forward: REP 103), so rows run downwards and columns to the right.
    """

    def __init__(self, stated: Camera, seed: int) -> None:
        self.width, self.height, self.range_m = stated.width, stated.height, stated.range_m
        self.fx = self.fy = self.width / 2 / tan(radians(stated.fov_deg) / 2)
        self.cx, self.cy = (self.width - 1) / 2, (self.height - 1) / 2
        self._noise_per_m, self._quantisation_m = stated.noise_per_m, stated.quantisation_m
        self._seed = seed
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        # In the body frame, with a forward part of one: distances along these rays are depths.
        self._rays = np.stack(
            [np.ones(u.shape), -(u - self.cx) / self.fx, -(v - self.cy) / self.fy], axis=-1
        ).reshape(-1, 3)
        self._farthest_m = self.range_m * float(np.linalg.norm(self._rays, axis=1).max())
        self._geom = np.empty(u.size, np.int32)
        self._depth = np.empty(u.size)

    def render(self, vehicle: Vehicle) -> NDArray[np.float32]:
        """Depth along the optical axis in m, float32 (height, width); obstacles and ground are seen.

        As REP 118 has it, +inf means nothing within range and -inf something too close to be measured.
        What lies beyond the range is not seen, however noise would have it: a standard deviation that grows
        with the square of depth is that of a reading within the range. What lies within and is read beyond
        counts as nothing within range, what is read at or below zero as too close. The noise is that of the
        vehicle's time: the same moment of the same flight gives the same image.
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
        # MuJoCo cuts off bodies, not hits: the ground is hit at any distance.
        seen = (self._geom >= 0) & (self._depth <= self.range_m)
        read = self._depth
        if self._noise_per_m:
            # Drawn for every pixel, so that none depends on what the others see.
            rng = generator(self._seed, "depth noise", vehicle.steps)
            read = read + rng.standard_normal(len(read), np.float32) * (self._noise_per_m * read**2)
        if self._quantisation_m:
            read = np.rint(read / self._quantisation_m) * self._quantisation_m
        near = np.where(read > 0.0, read, -np.inf)
        image = np.where(seen & (read <= self.range_m), near, np.inf).astype(np.float32)
        return image.reshape(self.height, self.width)
