"""The RGB camera: MuJoCo's renderer, where this machine has an offscreen OpenGL; no part of a flight.

A flight needs depth only, which is cast without a GPU. MuJoCo chooses its OpenGL when it is imported, by the
environment variable ``MUJOCO_GL``; ``sim/sensors/opengl.py`` finds out which value works.
"""

from __future__ import annotations

import os
from math import atan, degrees

import mujoco
import numpy as np
from numpy.typing import NDArray

from services.models.equipment import Camera
from sim.sensors.camera import DepthCamera
from sim.vehicle.airframe import airframe
from sim.vehicle.vehicle import Vehicle
from sim.world import make_world


class NoOpenGLError(RuntimeError):
    """Nothing renders offscreen on the machine, or with the chosen ``MUJOCO_GL``."""


def render(vehicle: Vehicle, camera: DepthCamera) -> NDArray[np.uint8]:
    """What an RGB camera with the depth camera's place and intrinsics sees: uint8 (height, width, 3).

    :raises NoOpenGLError: where there is no offscreen OpenGL.
    """
    vehicle.model.camera("front").fovy = 2 * degrees(atan(camera.height / 2 / camera.fy))
    try:
        with mujoco.Renderer(vehicle.model, camera.height, camera.width) as renderer:
            renderer.update_scene(vehicle.data, "front")
            image: NDArray[np.uint8] = renderer.render().copy()
    except (RuntimeError, AttributeError, ImportError, mujoco.FatalError) as error:
        message = f"no offscreen OpenGL with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}: {error}"
        raise NoOpenGLError(message) from error
    return image


if __name__ == "__main__":
    render(Vehicle(make_world("sparse", 0), airframe("airsim")), DepthCamera(Camera(), 0))
