"""What a flight sees, for who watches."""

import base64

import numpy as np

from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from deploy.recording.recorder import FlightRecorder
from deploy.recording.snapshot import FARTHEST_M, WIDEST, current_snapshot
from services.bus.horizon import Stamped
from services.bus.messages import decode
from services.bus.octomaps import SEEN_OCCUPIED, known
from services.bus.topics import TOPICS
from services.models.mission import Limits, MissionSpec

SPEC = MissionSpec(seed=7, limits=Limits(mission_time_s=6))


def test_the_newest_depth_image_and_map_are_shown_as_they_were_recorded(server: ForkServer) -> None:
    seen: list[FlightRecorder] = []
    fly(SPEC, server, watch=lambda _, recorder: seen.append(recorder))
    (recorder,) = seen
    shown = current_snapshot(recorder)
    assert shown is not None
    assert shown.depth is not None
    assert shown.map is not None

    last = recorder.last("depth")
    assert last is not None
    assert shown.time_s == last.ready_ns / 1e9
    image = decode(last.payload, TOPICS["depth"].type)
    pixels = np.frombuffer(base64.b64decode(shown.depth.data), dtype=np.uint8)
    assert (shown.depth.width, shown.depth.height) == (image.width, image.height) == (WIDEST, 36)
    metres = np.clip(np.nan_to_num(image.data.view(np.float32), posinf=FARTHEST_M), 0, FARTHEST_M)
    assert np.abs(pixels / 255 * FARTHEST_M - metres).max() < 0.1
    assert pixels.min() < 255

    bounds = np.array([-50.0, -50.0, 0.0]), np.array([50.0, 50.0, 10.0])
    voxels = known(base64.b64decode(shown.map.data), shown.map.resolution_m, *bounds)
    assert (voxels == SEEN_OCCUPIED).any()


def test_before_the_first_image_nothing_is_seen_and_nonsense_is_not_passed_on() -> None:
    recorder = FlightRecorder()
    assert current_snapshot(recorder) is None
    for topic in ("depth", "map"):
        recorder.record(topic, Stamped(0, 40_000_000, b"\0\1\0\0nonsense"))
    shown = current_snapshot(recorder)
    assert shown is not None
    assert shown.depth is None
    assert shown.map is None
