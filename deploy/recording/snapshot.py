"""The newest depth image and map of a flight, for viewers.

Both are recorded anyway. They are passed on small or as they are and drawn by who looks: a worker
shares its processor with the flight.
"""

from __future__ import annotations

import base64

import numpy as np
from pydantic import Field

from deploy.recording.recorder import FlightRecorder
from services.bus.messages import MalformedMessageError, decode
from services.bus.topics import TOPICS
from services.models.base import Strict

SNAPSHOTS_PER_S = 2.0
"""At most, of wall time."""

WIDEST = 64
"""Pixels of a depth image from left to right; a wider one is thinned out."""

FARTHEST_M = 20.0
"""What the brightest pixel of a depth image stands for; nothing was hit, or farther."""

_LARGEST_MAP = 200_000
"""Bytes of a map: a faulty one may be as large as it likes, and is not passed on."""


class DepthImage(Strict):
    """Distances, row by row from the upper left."""

    width: int
    height: int
    range_m: float = Field(description="what a byte of 255 stands for, or more; 0 is 0 m")
    data: str = Field(description="a byte a pixel, base64")


class MapCopy(Strict):
    """A copy of the occupancy map, as a binary octree."""

    resolution_m: float
    data: str = Field(description="binary OctoMap, base64")


class FlightSnapshot(Strict):
    """Depth image and map of a flight; None as long as there is none, or none that makes sense."""

    time_s: float = Field(description="virtual, since the beginning")
    depth: DepthImage | None
    map: MapCopy | None


def current_snapshot(recorder: FlightRecorder) -> FlightSnapshot | None:
    """The snapshot by the last messages; None before the first depth image."""
    last = recorder.last("depth")
    if last is None:
        return None
    return FlightSnapshot(time_s=last.ready_ns / 1e9, depth=_depth(last.payload), map=_map(recorder))


def _depth(payload: bytes) -> DepthImage | None:
    try:
        image = decode(payload, TOPICS["depth"].type)
        rows = image.data.view(np.float32).reshape(image.height, image.width)
    except (MalformedMessageError, ValueError):
        return None
    if not rows.size:
        return None
    step = -(-image.width // WIDEST)
    near = np.nan_to_num(rows[::step, ::step], nan=FARTHEST_M, posinf=FARTHEST_M, neginf=0.0)
    pixels = np.round(np.clip(near / FARTHEST_M, 0.0, 1.0) * 255).astype(np.uint8)
    return DepthImage(
        width=pixels.shape[1],
        height=pixels.shape[0],
        range_m=FARTHEST_M,
        data=base64.b64encode(pixels.tobytes()).decode(),
    )


def _map(recorder: FlightRecorder) -> MapCopy | None:
    last = recorder.last("map")
    if last is None or len(last.payload) > _LARGEST_MAP:
        return None
    try:
        message = decode(last.payload, TOPICS["map"].type)
    except MalformedMessageError:
        return None
    if not 0.01 <= message.resolution <= 10.0:
        return None
    return MapCopy(resolution_m=message.resolution, data=base64.b64encode(message.data.tobytes()).decode())
