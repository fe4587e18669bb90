"""Pictures of what a flight sees."""

import base64
import struct
import zlib

import numpy as np
import pytest
from numpy.typing import NDArray

from dashboard.web.charts.pictures import depth_picture, map_picture
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from deploy.recording.recorder import FlightRecorder
from deploy.recording.snapshot import DepthImage, MapCopy, current_snapshot
from services.models.mission import Limits, MissionSpec
from sim.world import World, make_world


def pixels(url: str, channels: int) -> NDArray[np.uint8]:
    """The image (height, width, channels) of a data URL."""
    content = base64.b64decode(url.removeprefix("data:image/png;base64,"))
    width, height = struct.unpack(">II", content[16:24])
    size = struct.unpack(">I", content[33:37])[0]
    rows = np.frombuffer(zlib.decompress(content[41 : 41 + size]), dtype=np.uint8).reshape(height, -1)
    return rows[:, 1:].reshape(height, width, channels)


def test_near_is_bright() -> None:
    data = base64.b64encode(bytes([0, 60, 255])).decode()
    picture = pixels(depth_picture(DepthImage(width=3, height=1, range_m=20.0, data=data)), 3)
    brightness = picture.sum(axis=2)[0]
    assert brightness[0] > brightness[1] > brightness[2]


@pytest.fixture(scope="module")
def world() -> World:
    return make_world("dense", 4)


def test_a_map_from_above_has_north_at_the_top_and_obstacles_where_they_are(
    server: ForkServer, world: World
) -> None:
    seen: list[FlightRecorder] = []
    spec = MissionSpec(world="dense", seed=4, limits=Limits(mission_time_s=20))
    fly(spec, server, watch=lambda _, recorder: seen.append(recorder))
    shown = current_snapshot(seen[0])
    assert shown is not None
    assert shown.map is not None
    url = map_picture(shown.map, world)
    assert url is not None
    picture = pixels(url, 4)
    assert picture.shape == (200, 200, 4)
    occupied = (picture == (213, 94, 0, 255)).all(axis=2)
    assert occupied.any()
    rows, columns = np.nonzero(occupied)
    east = world.bounds[0, 0] + (columns + 0.5) * 0.5
    north = world.bounds[1, 1] - (rows + 0.5) * 0.5
    grown = world.obstacles[:, [0, 1, 3, 4]] + np.array([-1.0, -1.0, 1.0, 1.0])
    inside = [
        ((grown[:, 0] <= x) & (x <= grown[:, 2]) & (grown[:, 1] <= y) & (y <= grown[:, 3])).any()
        for x, y in zip(east, north, strict=True)
    ]
    assert np.mean(inside) > 0.9


def test_what_is_no_map_is_no_picture(world: World) -> None:
    assert map_picture(MapCopy(resolution_m=0.5, data=base64.b64encode(b"abc").decode()), world) is None
