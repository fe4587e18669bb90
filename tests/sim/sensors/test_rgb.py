"""RGB rendering; each case in a process of its own, since MuJoCo chooses its OpenGL at import."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from sim.sensors.opengl import backend

SCENE = """
import numpy as np
from services.models.equipment import Camera
from sim.vehicle.airframe import airframe
from sim.sensors.camera import DepthCamera
from sim.sensors.rgb import NoOpenGLError, render
from sim.vehicle.vehicle import Vehicle
from tests.sim.worlds import world_with
camera = DepthCamera(Camera(noise_per_m=0), 0)
vehicle = Vehicle(world_with((5.0, 2.0, 0.0, 6.0, 3.0, 20.0)), airframe("airsim"))
"""


def run(program: str, gl: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", SCENE + program],
        env={**os.environ, "MUJOCO_GL": gl},
        capture_output=True,
        text=True,
        check=True,
        timeout=600,
    )
    return done.stdout


def test_it_sees_the_box_and_the_ground_where_the_depth_camera_does() -> None:
    gl = backend()
    if gl is None:
        pytest.skip("no offscreen OpenGL on this machine")
    program = """
image, depth = render(vehicle, camera).astype(int), camera.render(vehicle)
assert image.shape == (36, 64, 3)
box = np.isfinite(depth[0])[None, :] & (np.arange(36) < 16)[:, None]
red = image[..., 0] - image[..., 2]
print(red[box].min(), red[:16, 40:].max(), image[-1, 40:, 1].mean() > image[-1, 40:, 0].mean())
"""
    lowest_on_box, highest_in_sky, ground_is_green = run(program, gl).split()
    assert int(lowest_on_box) > int(highest_in_sky)
    assert ground_is_green == "True"


def test_without_opengl_it_says_so() -> None:
    program = """
try:
    render(vehicle, camera)
except NoOpenGLError as error:
    print(error)
"""
    assert "no offscreen OpenGL with MUJOCO_GL='disable'" in run(program, "disable")
