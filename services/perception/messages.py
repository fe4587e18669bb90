"""Perception's messages from and to the arrays of its kernels."""

from __future__ import annotations

from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.bus.arrays import Plan
from services.bus.message_checks import ALL_CHECKS, Checks, refuse
from services.bus.messages import (
    CameraInfo,
    CollisionCheck,
    Header,
    Image,
    MalformedMessageError,
    Octomap,
)
from services.perception.occupancy import OccupancyMap


def depth_array(image: Image, _: Checks = ALL_CHECKS) -> NDArray[np.float32]:
    """The depth image (h, w) of a 32FC1 message.

    :raises MalformedMessageError: if it has another encoding or number of pixels, or none at all.
    """
    pixels = image.height * image.width
    if image.encoding != "32FC1" or image.is_bigendian or not pixels or image.data.size != 4 * pixels:
        size = f"{image.width} x {image.height} pixels in {image.data.size} bytes"
        raise MalformedMessageError(f"depth image: {image.encoding!r}, {size}")
    return image.data.view(np.float32).reshape(image.height, image.width)


class Pinhole(NamedTuple):
    """A camera's intrinsics, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


def pinhole(info: CameraInfo, checks: Checks = ALL_CHECKS) -> Pinhole:
    """The camera that a message describes.

    :raises RefusedMessageError: if no camera has such intrinsics.
    """
    fx, cx, fy, cy = info.k[[0, 2, 4, 5]]
    refuse(checks, "finite", "camera: not finite", unless=bool(np.isfinite([fx, fy, cx, cy]).all()))
    refuse(checks, "range", "camera: no such lens", unless=bool(fx > 0.0 and fy > 0.0))
    return Pinhole(fx, fy, cx, cy)


def map_message(header: Header, occupancy: OccupancyMap) -> Any:
    """The occupancy map as a binary octree."""
    return Octomap(
        header=header,
        binary=True,
        id="OcTree",
        resolution=occupancy.resolution_m,
        data=np.frombuffer(occupancy.to_binary(), dtype=np.int8),
    )


def check_message(header: Header, plan: Plan, future_collision_seq: int, time_to_collision_s: float) -> Any:
    """The verdict on ``plan``; the header's stamp is the time from which the time to collision counts."""
    return CollisionCheck(
        header=header,
        trajectory_seq=plan.trajectory_seq,
        future_collision_seq=future_collision_seq,
        collision=isfinite(time_to_collision_s),
        time_to_collision=time_to_collision_s,
    )
