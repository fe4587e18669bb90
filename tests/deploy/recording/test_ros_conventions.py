"""Recordings mean what ROS's conventions say: frames, transforms, clouds, twists, covariances, units.

Everything is read by rosbags, and compared with the world's geometry and with each other, not with our code.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.mission import Limits, MissionSpec
from sim.world import World, make_world
from tests.deploy.recording.test_recordings import middles, rms

Floats = NDArray[np.float64]

WORLDS = ("clustered", "dense", "factory", "farm", "forest", "gates", "sparse", "traffic")
SOON = Limits(mission_time_s=4.0)
GATE = (
    MissionSpec(world="sparse", seed=31, limits=Limits(mission_time_s=12.0)),
    MissionSpec(world="traffic", airframe="spark", seed=32, limits=Limits(mission_time_s=8.0)),
    MissionSpec(world="sparse", clock="realtime", seed=33, limits=SOON),
)
REST = (
    *(MissionSpec(world=world, seed=40) for world in WORLDS),
    *(MissionSpec(world=world, airframe="spark", seed=41) for world in WORLDS),
    MissionSpec(world="traffic", clock="realtime", seed=42, limits=SOON),
)
RISING_M = 0.02
"""How far the depth's float32, the rounding to millimetres and a physics step of motion may move a point."""


class Told(NamedTuple):
    """A flight and its messages by topic, in their order."""

    spec: MissionSpec
    messages: Mapping[str, list[Any]]

    @property
    def poses(self) -> dict[int, tuple[Rotation, Floats]]:
        """Where the vehicle is at each stamp of ``/tf``."""
        (moved,) = zip(*(one.transforms for one in self.messages["/tf"]), strict=True)
        return {stamp(one.header): pose(one.transform) for one in moved}


def stamp(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def pose(transform: Any) -> tuple[Rotation, Floats]:
    q, at = transform.rotation, transform.translation
    return Rotation.from_quat((q.x, q.y, q.z, q.w)), np.array([at.x, at.y, at.z])


@pytest.fixture(
    scope="module",
    params=[*GATE, *(pytest.param(spec, marks=pytest.mark.soak) for spec in REST)],
    ids=lambda spec: f"{spec.world}-{spec.airframe}-{spec.clock}",
)
def told(
    request: pytest.FixtureRequest, server: ForkServer, tmp_path_factory: pytest.TempPathFactory
) -> Told:
    path = tmp_path_factory.mktemp("flight") / "flight.mcap"
    PairFlyer(server).fly(request.param, path)
    messages = defaultdict(list)
    with AnyReader([path]) as bag:
        for connection, _, raw in bag.messages():
            messages[connection.topic].append(bag.deserialize(raw, connection.msgtype))
    return Told(request.param, messages)


def test_frames_are_one_tree_that_is_known_at_every_stamp(told: Told) -> None:
    fixed = [one for (message,) in [told.messages["/tf_static"]] for one in message.transforms]
    parents: dict[str, set[str]] = defaultdict(set)
    for one in (*fixed, *(moved for message in told.messages["/tf"] for moved in message.transforms)):
        parents[one.child_frame_id].add(one.header.frame_id)
    assert parents == {
        "odom": {"map"},
        "base_link": {"odom"},
        "camera_link": {"base_link"},
        "camera_optical_frame": {"camera_link"},
    }
    known = sorted(told.poses)
    assert known[0] == 0
    fixed_frames = {"map", "odom"}
    for topic in ("/odometry", "/depth", "/cloud", "/map", "/trajectory", "/command", "/collision_check"):
        for message in told.messages[topic]:
            frame, at = message.header.frame_id, stamp(message.header)
            assert frame in {"map", *parents}, topic
            # What moves is looked up between two stamps; pictures and clouds are at one of them.
            assert frame in fixed_frames or at in told.poses, (topic, at)
            assert at <= known[-1] + 1_000_000_000
    for message in told.messages["/imu/data_raw"]:
        assert message.header.frame_id == "base_link"
        assert 0 < stamp(message.header) <= known[-1]


def test_clouds_are_what_a_lidar_s_would_be(told: Told) -> None:
    """In the sensor's frame; every point lies on a surface, to the camera's noise."""
    ((mounted,),) = [
        [one for one in message.transforms if one.child_frame_id == "camera_optical_frame"]
        for message in told.messages["/tf_static"]
    ]
    turn, _ = pose(mounted.transform)
    world = make_world(told.spec.world, told.spec.seed)
    poses, noise = told.poses, told.spec.camera.noise_per_m
    points_seen, farthest = 0, 0.0
    for cloud in told.messages["/cloud"]:
        assert cloud.header.frame_id == "camera_optical_frame"
        assert cloud.is_dense
        points = cloud.data.view("<f4").reshape(-1, 3).astype(np.float64)
        assert len(points) == cloud.width * cloud.height
        assert np.isfinite(points).all()
        attitude, position = poses[stamp(cloud.header)]
        in_map = attitude.apply(turn.apply(points)) + position
        # Noise is along the optical axis: along the ray it is longer by what the ray leans.
        lean = np.linalg.norm(points, axis=1) / points[:, 2]
        allowed = 6 * noise * points[:, 2] ** 2 * lean + RISING_M
        off = from_surfaces(in_map, world, stamp(cloud.header) / 1e9) - allowed
        assert not (off > 0).any(), (stamp(cloud.header), off.max())
        points_seen += len(points)
        farthest = max(farthest, float(np.linalg.norm(points, axis=1).max(initial=0.0)))
    assert points_seen > 1000
    assert farthest <= told.spec.mapping.range_m + 1e-3


def from_surfaces(points: Floats, world: World, time_s: float) -> Floats:
    """The distance of each point from the nearest face of a box, or the ground."""
    boxes = np.vstack([world.fixed, world.moved(time_s)]) if len(world.moving) else world.fixed
    nearest = np.abs(points[:, 2])
    for box in boxes:
        low, high = box[:3] - points, points - box[3:]
        outside = np.linalg.norm(np.maximum(np.maximum(low, high), 0.0), axis=1)
        inside = -np.maximum(low, high).max(axis=1)
        nearest = np.minimum(nearest, np.where(inside > 0, inside, outside))
    return np.asarray(nearest)


def test_the_twist_is_the_derivative_of_the_pose(told: Told) -> None:
    """As nav_msgs/Odometry has it: in child_frame_id."""
    sent = told.messages["/odometry"]
    assert {(one.header.frame_id, one.child_frame_id) for one in sent} == {("odom", "base_link")}
    step_s = np.diff([stamp(one.header) for one in sent])[:, None] / 1e9
    quaternions = [one.pose.pose.orientation for one in sent]
    attitudes = Rotation.from_quat([(q.x, q.y, q.z, q.w) for q in quaternions])
    positions = np.array([(p.x, p.y, p.z) for p in (one.pose.pose.position for one in sent)])
    linear = np.array([(v.x, v.y, v.z) for v in (one.twist.twist.linear for one in sent)])
    angular = np.array([(w.x, w.y, w.z) for w in (one.twist.twist.angular for one in sent)])
    moved = np.diff(positions, axis=0) / step_s - middles(attitudes.apply(linear))
    turned = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec() / step_s - middles(angular)
    assert rms(np.diff(positions, axis=0) / step_s) > 0.5, "it flies"
    assert rms(moved) < 0.02
    assert rms(turned) < 0.05
    for one in (sent[0], sent[-1]):
        for stated in (one.pose.covariance, one.twist.covariance):
            assert (np.linalg.eigvalsh(stated.reshape(6, 6)) > 0).all()


def test_standard_messages_say_what_ours_do(told: Told) -> None:
    samples = told.messages["/imu/data_raw"]
    forces = np.array([(f.x, f.y, f.z) for f in (one.linear_acceleration for one in samples)])
    assert len(samples) == sum(len(batch.time_ns) for batch in told.messages["/imu"])
    assert np.median(forces[:, 2]) == pytest.approx(9.8, abs=1.0), "what an accelerometer reads at rest"
    assert samples[0].orientation_covariance[0] == -1
    assert samples[0].angular_velocity_covariance[0] == pytest.approx(told.spec.imu.gyro_noise_rad_s**2)
    charges = [one.percentage for one in told.messages["/battery"]]
    assert charges[0] == pytest.approx(1.0, abs=0.01)
    assert charges == sorted(charges, reverse=True)
    health = [one.status for one in told.messages["/diagnostics"]]
    assert {one.name for statuses in health for one in statuses} >= {"zenfi: mission"}
    assert health[0][0].message == "flying"
    assert len(health) == len(told.messages["/mission"])
    for ours, theirs in zip(told.messages["/trajectory"], told.messages["/planned_trajectory"], strict=True):
        rows = ours.points.reshape(-1, 12)
        times = [one.time_from_start.sec + one.time_from_start.nanosec / 1e9 for one in theirs.points]
        assert stamp(theirs.header) / 1e9 + np.array(times) == pytest.approx(rows[:, 0], abs=1e-6)
        places = [(at.x, at.y, at.z) for at in (one.transforms[0].translation for one in theirs.points)]
        assert np.array(places).reshape(-1, 3) == pytest.approx(rows[:, 1:4])
        speeds = [(v.x, v.y, v.z) for v in (one.velocities[0].linear for one in theirs.points)]
        assert np.array(speeds).reshape(-1, 3) == pytest.approx(rows[:, 4:7])


def test_drift_is_stated(server: ForkServer, tmp_path: Path) -> None:
    spec = MissionSpec.model_validate({"seed": 7, "odometry": {"drift_m_sqrt_s": 0.1}, "limits": SOON})
    PairFlyer(server).fly(spec, tmp_path / "flight.mcap")
    with AnyReader([tmp_path / "flight.mcap"]) as bag:
        connections = [one for one in bag.connections if one.topic == "/odometry"]
        sent: list[Any] = [bag.deserialize(raw, one.msgtype) for one, _, raw in bag.messages(connections)]
    at_s = np.array([stamp(one.header) / 1e9 for one in sent])
    variances = np.array([one.pose.covariance[[0, 7, 14]] for one in sent])
    assert variances == pytest.approx(np.outer(0.01 * at_s, np.ones(3)), abs=1e-6)
