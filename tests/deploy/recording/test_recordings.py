"""Recordings open everywhere, repeat, and outlive their flight."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from dashboard.analysis.recordings_reader import open_run
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.recording.derived import DERIVED
from deploy.recording.ordering import TYPES
from services.bus.topics import RECORDED, TICK_NS
from tests.conftest import wait_until
from tests.dashboard.recorded import FAULTY, GOLDEN, flights

__all__ = ["flights"]

TICK_S = TICK_NS / 1e9
RERUN = Path(sys.executable).parent / "rerun"
NATIVE = {
    "cloud": "Points3D:positions",
    "occupied": "Points3D:positions",
    "pose": "InstancePoses3D:translations",
    "tf": "Transform3D:translation",
    "depth": "DepthImage:buffer",
    "camera_info": "Pinhole:image_from_camera",
    "imu/data_raw": "Scalars:scalars",
}
"""What Rerun is to make of a topic, beyond its fields."""


def test_recording_changes_nothing_in_a_flight(server: ForkServer, flights: dict[str, Path]) -> None:
    for name, spec in (("golden", GOLDEN), ("faulty", FAULTY)):
        assert open_run(flights[name]).about["digest"] == PairFlyer(server).fly(spec).digest


def test_two_recordings_of_a_flight_are_the_same_to_the_byte(flights: dict[str, Path]) -> None:
    for name in ("golden", "faulty"):
        assert flights[name].read_bytes() == flights[f"{name}-again"].read_bytes()
    assert flights["golden"].read_bytes() != flights["faulty"].read_bytes()


def test_a_recording_holds_every_message_in_the_order_of_virtual_time(flights: dict[str, Path]) -> None:
    recording = open_run(flights["faulty"])
    assert set(recording.messages) == {*TYPES, *DERIVED} - {"task", "alarm", "moving_obstacles"}
    assert all(
        [message.seq for message in sent] == list(range(len(sent))) for sent in recording.messages.values()
    )
    with flights["faulty"].open("rb") as stream:
        times = [
            message.log_time for _, _, message in make_reader(stream).iter_messages(log_time_order=False)
        ]
    assert times == sorted(times)
    assert recording.about["campaign"] == "tests-1"
    assert recording.spec.model_copy(update={"fault": None}) == GOLDEN
    assert recording.injection is not None
    assert recording.injection.status == "injected"
    assert recording.injection.pid == 0  # or no two recordings would be the same


def test_the_file_is_sound_by_the_book(flights: dict[str, Path]) -> None:
    """What ``mcap doctor`` looks at: magic, checksums, indexes that lead where they say, counts, sizes."""
    for path in flights.values():
        with path.open("rb") as stream:
            records = list(StreamReader(stream, emit_chunks=True, validate_crcs=True).records)
        chunks = [record for record in records if isinstance(record, Chunk)]
        indexes = [record for record in records if isinstance(record, ChunkIndex)]
        assert len(chunks) == len(indexes) > 1
        for chunk, index in zip(chunks, indexes, strict=True):
            assert chunk.compression == "zstd"
            assert chunk.uncompressed_size <= 1_000_000
            assert (chunk.message_start_time, chunk.message_end_time) == (
                index.message_start_time,
                index.message_end_time,
            )
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            counted = dict.fromkeys(summary.channels, 0)
            for _, channel, _ in reader.iter_messages():
                counted[channel.id] += 1
            assert counted == summary.statistics.channel_message_counts
            assert reader.get_header().profile == "ros2"


def test_others_decode_every_message(flights: dict[str, Path]) -> None:
    path, ours = flights["faulty"], open_run(flights["faulty"])
    count = sum(map(len, ours.messages.values()))
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        read = [(channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()]
    assert len(read) == count
    heights = [message.pose.pose.position.z for topic, message in read if topic == "/odometry"]
    assert heights == list(ours.table("odometry")["pose.pose.position.z"])
    with AnyReader([path]) as bag:
        told = [bag.deserialize(raw, one.msgtype) for one, _, raw in bag.messages()]
        assert {one.topic for one in bag.connections} == {f"/{topic}" for topic in ours.messages}
    assert len(told) == count


def test_odometry_tells_its_twist_in_the_body_frame(flights: dict[str, Path]) -> None:
    """As nav_msgs/Odometry has it: in child_frame_id. Both parts are the derivative of the pose."""
    with AnyReader([flights["golden"]]) as bag:
        connections = [one for one in bag.connections if one.topic == "/odometry"]
        told: list[Any] = [bag.deserialize(raw, one.msgtype) for one, _, raw in bag.messages(connections)]
    assert {(one.header.frame_id, one.child_frame_id) for one in told} == {("odom", "base_link")}
    poses, twists = [one.pose.pose for one in told], [one.twist.twist for one in told]
    attitudes = Rotation.from_quat([(q.x, q.y, q.z, q.w) for q in (pose.orientation for pose in poses)])
    positions = np.array([(p.x, p.y, p.z) for p in (pose.position for pose in poses)])
    linear = np.array([(v.x, v.y, v.z) for v in (twist.linear for twist in twists)])
    angular = np.array([(w.x, w.y, w.z) for w in (twist.angular for twist in twists)])
    moved = np.diff(positions, axis=0) / TICK_S - middles(attitudes.apply(linear))
    turned = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec() / TICK_S - middles(angular)
    assert rms(np.diff(positions, axis=0) / TICK_S) > 2.0, "it flies"
    assert rms(moved) < 0.01
    assert rms(turned) < 0.05


def middles(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean of each two neighbouring rows."""
    return np.asarray((rows[1:] + rows[:-1]) / 2)


def rms(vectors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def test_rerun_draws_it(flights: dict[str, Path], tmp_path: Path) -> None:
    converted, home = tmp_path / "flight.rrd", {**os.environ, "HOME": str(tmp_path)}
    done = subprocess.run(
        [RERUN, "mcap", "convert", flights["faulty"], "-o", converted],
        capture_output=True,
        text=True,
        check=True,
        env=home,
    )
    assert not [line for line in done.stderr.splitlines() if " ERROR" in line]
    for topic, drawn in NATIVE.items():
        shown = subprocess.run(
            [RERUN, "rrd", "print", "-vv", "--entity", f"/{topic}", converted],
            capture_output=True,
            text=True,
            check=True,
            env=home,
        )
        assert drawn in shown.stdout, topic


def test_what_is_drawn_is_what_was_flown(flights: dict[str, Path]) -> None:
    recording = open_run(flights["golden"])
    odometry, tf = recording.table("odometry"), list(recording.decoded("tf"))
    assert [one.transforms[0].transform.translation.x for one in tf] == list(odometry["pose.pose.position.x"])
    (obstacles,), (path, *_) = recording.decoded("obstacles"), recording.decoded("planned_path")
    (trajectory, *_) = recording.decoded("trajectory")
    assert [pose.pose.position.y for pose in path.poses] == list(trajectory.points[2::12])
    boxes = [(one.pose.position, one.scale) for one in obstacles.markers]
    # Of what the map calls occupied, nearly all lies within half a voxel of an obstacle or the ground.
    cloud = list(recording.decoded("occupied"))[-1].data.view("<f4").reshape(-1, 3)
    inside = [
        any(abs(x - at.x) <= size.x / 2 + 0.5 and abs(y - at.y) <= size.y / 2 + 0.5 for at, size in boxes)
        or z < 0.5
        for x, y, z in cloud
    ]
    assert sum(inside) > 0.95 * len(inside) > 100


def test_a_killed_flight_leaves_what_was_written(tmp_path: Path, flights: dict[str, Path]) -> None:
    path = tmp_path / "killed.mcap"
    script = (
        "from pathlib import Path\n"
        "from deploy.mission.fork_server import ForkServer\n"
        "from deploy.pairing.golden_twin import PairFlyer\n"
        "from tests.dashboard.recorded import GOLDEN\n"
        f"PairFlyer(ForkServer()).fly(GOLDEN, Path({str(path)!r}))\n"
    )
    whole = open_run(flights["golden"])
    with subprocess.Popen([sys.executable, "-c", script]) as flight:
        wait_until(lambda: path.exists() and path.stat().st_size > 100_000)

        def has_odometry() -> bool:
            """Look while it stands: reading takes longer than the flight. The first chunk may be pictures."""
            flight.send_signal(signal.SIGSTOP)
            enough = len(open_run(path).messages.get("odometry", [])) > 10
            if not enough:
                flight.send_signal(signal.SIGCONT)
            return enough

        wait_until(has_odometry)
        flight.send_signal(signal.SIGKILL)
    left = open_run(path)
    assert not left.complete
    assert whole.complete
    assert 10 < len(left.messages["odometry"]) < len(whole.messages["odometry"])
    for topic, sent in left.messages.items():
        assert sent == whole.messages[topic][: len(sent)]
    repaired = subprocess.run(
        [RERUN, "mcap", "convert", "--recover", path, "-o", tmp_path / "killed.rrd"],
        capture_output=True,
        check=False,
        env={**os.environ, "HOME": str(tmp_path)},
    )
    assert repaired.returncode == 0


@pytest.mark.parametrize("cut", [0.3, 0.5, 0.77, 0.999])
def test_every_complete_chunk_of_a_broken_file_is_read(
    tmp_path: Path, flights: dict[str, Path], cut: float
) -> None:
    whole = flights["golden"].read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: int(cut * len(whole))])
    with flights["golden"].open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    complete = [
        one
        for one in summary.chunk_indexes
        if one.chunk_start_offset + one.chunk_length <= int(cut * len(whole))
    ]
    last_ns = max(one.message_end_time for one in complete)
    left, every = open_run(path), open_run(flights["golden"])
    assert not left.complete
    for topic in (topic.name for topic in RECORDED):
        sent = left.messages.get(topic, [])
        assert sent == every.messages.get(topic, [])[: len(sent)]
    assert max(sent[-1].ready_ns for sent in left.messages.values() if sent) == last_ns
