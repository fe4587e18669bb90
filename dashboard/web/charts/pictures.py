"""What a flight sees as pictures: depth images and maps from above, as PNG in data URLs."""

from __future__ import annotations

import base64
import binascii

import numpy as np
from numpy.typing import NDArray

from dashboard.analysis.plan import encode_png
from deploy.recording.snapshot import DepthImage, MapCopy
from sim.world import World

GROUND_M = 1.0
"""What is lower is no obstacle: noise spreads the ground over some voxels."""

_NEAR, _FAR = np.array([253.0, 231.0, 37.0]), np.array([30.0, 10.0, 60.0])
"""Bright is near: one way from light to dark, told apart also without colours."""

_UNKNOWN, _FREE, _OCCUPIED = (0, 0, 0, 0), (86, 180, 233, 110), (213, 94, 0, 255)
"""Of Okabe and Ito's palette, with opacity."""


def depth_picture(image: DepthImage) -> str:
    """A depth image, near things bright."""
    pixels = np.frombuffer(base64.b64decode(image.data), dtype=np.uint8)
    far = pixels.reshape(image.height, image.width, 1) / 255
    return _url((_NEAR + (_FAR - _NEAR) * np.sqrt(far)).astype(np.uint8))


def map_picture(seen: MapCopy, world: World) -> str | None:
    """The map from above, north up, a pixel a voxel over the world's bounds; None if it is none.

    A column is occupied if any of its voxels above the ground is, free if any is known to be.
    """
    from services.bus.octomaps import MalformedMap, known  # noqa: PLC0415 - loads numba

    low = world.bounds[0] + (0.0, 0.0, GROUND_M)
    try:
        voxels = known(base64.b64decode(seen.data), seen.resolution_m, low, world.bounds[1])
    except (MalformedMap, binascii.Error):
        return None
    return _url(_from_above(voxels))


def _from_above(voxels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    from services.bus.octomaps import SEEN_FREE, SEEN_OCCUPIED  # noqa: PLC0415 - loads numba

    picture = np.empty((*voxels.shape[:2], 4), dtype=np.uint8)
    picture[:] = _UNKNOWN
    picture[(voxels == SEEN_FREE).any(axis=2)] = _FREE
    picture[(voxels == SEEN_OCCUPIED).any(axis=2)] = _OCCUPIED
    # x is east and grows to the right, y north and grows upwards.
    return np.ascontiguousarray(picture.transpose(1, 0, 2)[::-1])


def _url(image: NDArray[np.uint8]) -> str:
    return f"data:image/png;base64,{base64.b64encode(encode_png(image)).decode()}"
