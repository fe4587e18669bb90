"""The table of topics: the only place where a message stream is declared.

The order of publishers in the table is the order of stages within one instant of virtual time:
a stage sees what stages before it publish at that instant, and what stages after it (or itself)
published strictly earlier. That rule is what makes a loop of zero-latency stages well defined.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

TICK_NS = 40_000_000
"""Control period and camera period: 25 Hz, the authors' camera rate (facts page)."""

PLANNER = "$planner"
"""Stands in a chain of kernels for the planner that the mission chose."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One message stream: its name, type and publisher, and what triggers its messages.

    ``trigger`` is the topic whose message sets the publisher going (none: the publisher owns the
    clock), ``after`` the kernels that at least run between the two: their latencies are how far
    ahead the publisher can promise silence. A ``latched`` topic's last message is given to a
    subscriber that comes later (ROS 2: transient local); a ``stream`` is not. What is not
    ``recorded`` stands outside virtual time: it contains wall times and pids.
    """

    name: str
    type: str
    publisher: str
    trigger: str | None
    after: tuple[str, ...]
    qos: Literal["stream", "latched"]
    recorded: bool

    @property
    def rank(self) -> int:
        """Position of the publisher among the stages within one instant."""
        return STAGES.index(self.publisher)


_PERCEPTION = ("point_cloud", "octomap")

_TABLE = (
    Topic("goal", "zenfi_msgs/msg/Goal", "sim", None, (), "latched", True),
    Topic("task", "zenfi_msgs/msg/Task", "sim", None, (), "latched", True),
    Topic("camera_info", "sensor_msgs/msg/CameraInfo", "sim", None, (), "latched", True),
    Topic("odometry", "nav_msgs/msg/Odometry", "sim", None, (), "stream", True),
    Topic("imu", "zenfi_msgs/msg/ImuBatch", "sim", None, (), "stream", True),
    Topic("depth", "sensor_msgs/msg/Image", "sim", None, (), "stream", True),
    Topic("mission", "zenfi_msgs/msg/Mission", "sim", None, (), "latched", True),
    Topic("cloud", "sensor_msgs/msg/PointCloud2", "perception", "depth", _PERCEPTION[:1], "stream", True),
    Topic("map", "octomap_msgs/msg/Octomap", "perception", "depth", _PERCEPTION, "latched", True),
    Topic(
        "collision_check",
        "zenfi_msgs/msg/CollisionCheck",
        "perception",
        "depth",
        (*_PERCEPTION, "collision_check"),
        "latched",
        True,
    ),
    Topic(
        "trajectory",
        "zenfi_msgs/msg/Trajectory",
        "planning",
        "collision_check",
        (PLANNER,),
        "latched",
        True,
    ),
    Topic("command", "geometry_msgs/msg/TwistStamped", "control", "odometry", ("pid",), "stream", True),
    Topic("injection", "zenfi_msgs/msg/Injection", "injector", None, (), "latched", False),
)

TOPICS: Mapping[str, Topic] = MappingProxyType({topic.name: topic for topic in _TABLE})

RECORDED: tuple[Topic, ...] = tuple(topic for topic in _TABLE if topic.recorded)
"""What exists by virtual time and is the same in every repetition of a flight."""

STAGES: tuple[str, ...] = tuple(dict.fromkeys(topic.publisher for topic in RECORDED))

MADE_FROM: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        **dict.fromkeys(("goal", "task", "camera_info"), ()),
        **dict.fromkeys(("odometry", "imu", "depth"), ("command",)),
        "mission": ("command", "trajectory"),
        "cloud": ("depth", "odometry", "camera_info"),
        "map": ("cloud", "odometry"),
        "collision_check": ("map", "odometry", "trajectory"),
        "trajectory": ("collision_check", "odometry", "map", "goal", "task"),
        "command": ("odometry", "collision_check", "trajectory"),
    }
)
"""What each recorded topic is made from: the ways by which an error passes on."""


OVER_LINK = frozenset({"odometry", "imu", "depth", "command"})
"""The topics between the companion computer and what it flies: they go over the mission's link. The others
stay on one side of it, or tell once what is known before take-off."""


CARRIERS: Mapping[str, str] = MappingProxyType({"sim": "odometry", "control": "command"})
"""The topics whose messages carry the promise that their publisher makes after them, so that it need not be
sent on its own: those with a message in (nearly) every step."""


@functools.cache
def published_by(stage: str) -> tuple[Topic, ...]:
    """The topics of one stage, in the order of the table."""
    return tuple(topic for topic in _TABLE if topic.publisher == stage)
