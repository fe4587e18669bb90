"""A ROS 2 node, as another implementation makes one, flies the vehicle in control's place."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys.stores import ros2_jazzy as ros
from zenoh_ros2_sdk import ROS2Subscriber

from deploy.errors import InfrastructureError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from services.models.mission import Limits, MissionSpec
from tests.fixtures import ros_nodes
from tests.fixtures.own_stacks import read

DOMAIN = 11


class Ascent:
    """A node that climbs, faster the lower it is: it answers each odometry with one command."""

    def __init__(self, port: int) -> None:
        twist = ros_nodes.described("geometry_msgs/msg/TwistStamped", {})
        self._publisher = ros_nodes.publisher(port, DOMAIN, "/command", twist)
        self._subscriber = ROS2Subscriber(
            "/odometry",
            callback=self._answer,
            domain_id=DOMAIN,
            router_ip="127.0.0.1",
            router_port=port,
            **ros_nodes.described("nav_msgs/msg/Odometry", {}),
        )

    def _answer(self, odometry: Any) -> None:
        climb = 0.5 * (6.0 - odometry.pose.pose.position.z)
        linear = ros.geometry_msgs__msg__Vector3(x=0.0, y=0.0, z=climb)
        still = ros.geometry_msgs__msg__Vector3(x=0.0, y=0.0, z=0.0)
        twist = ros.geometry_msgs__msg__Twist(linear=linear, angular=still)
        self._publisher.publish(header=odometry.header, twist=twist)

    def close(self) -> None:
        self._subscriber.close()
        self._publisher.close()


@pytest.fixture
def node(port: int) -> Iterator[Ascent]:
    one = Ascent(port)
    yield one
    one.close()


def mission(folder: Path, port: int, patience_s: float) -> MissionSpec:
    relay = "from dashboard.cli import main; main()"
    options = [
        "--domain",
        str(DOMAIN),
        "--endpoint",
        f"tcp/127.0.0.1:{port}",
        "--patience-s",
        str(patience_s),
    ]
    command = [sys.executable, "-c", relay, "ros2", "stage", *options]
    file = folder / "ros.toml"
    latency = "latency = { mean_ms = 2 }"
    file.write_text(f'name = "ros"\n[stages.control]\ncommand = {json.dumps(command)}\n{latency}\n')
    return MissionSpec(seed=7, stack=read(file), limits=Limits(mission_time_s=3.0))


@pytest.mark.usefixtures("node")
def test_it_flies_in_virtual_time_and_the_same_again(tmp_path: Path, port: int, server: ForkServer) -> None:
    spec = mission(tmp_path, port, 30.0)
    first = fly(spec, server, keep_messages=True)
    assert first.outcome.result == "timeout"
    assert first.outcome.topics["command"].messages == 75
    assert first.outcome.nodes["control"].causes == []
    assert first.outcome.qof.distance_m > 2.0
    assert fly(spec, server).outcome.digest == first.outcome.digest


def test_where_there_is_no_node_it_says_so(tmp_path: Path, port: int, server: ForkServer) -> None:
    with pytest.raises(InfrastructureError, match="publishes"):
        fly(mission(tmp_path, port, 1.0), server)
