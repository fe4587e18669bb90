"""What recordings and ROS 2 domains hold beside a flight's own messages: standard ones, made from them.

The flight knows nothing of them: they are made where a flight is recorded or shown, and cost it nothing.
A message of the flight that makes no sense gives none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from deploy.recording.ordering import SentMessage
from deploy.recording.sensor_messages import SensorMessages
from deploy.recording.visualization import Visualization
from services.bus.horizon import Stamped
from services.bus.messages import MalformedMessageError, decode, encode
from services.bus.ros2 import Qos
from services.bus.topics import TOPICS
from services.models.mission import MissionSpec

_LAST = Qos(transient_local=True, depth=1)
_STREAM = Qos(depth=10)
_TF = Qos(depth=100)
"""As tf2 has it: ``DynamicBroadcasterQoS``; its ``StaticBroadcasterQoS`` is to keep the last."""


class DerivedTopic(NamedTuple):
    """A stream of derived messages: its type, and its quality of service in ROS."""

    type: str
    quality: Qos


DERIVED: Mapping[str, DerivedTopic] = MappingProxyType(
    {
        "tf_static": DerivedTopic("tf2_msgs/msg/TFMessage", _LAST),
        "tf": DerivedTopic("tf2_msgs/msg/TFMessage", _TF),
        "pose": DerivedTopic("geometry_msgs/msg/PoseStamped", _STREAM),
        "imu/data_raw": DerivedTopic("sensor_msgs/msg/Imu", _TF),
        "battery": DerivedTopic("sensor_msgs/msg/BatteryState", _LAST),
        "diagnostics": DerivedTopic("diagnostic_msgs/msg/DiagnosticArray", _STREAM),
        "planned_trajectory": DerivedTopic("trajectory_msgs/msg/MultiDOFJointTrajectory", _LAST),
        "planned_path": DerivedTopic("nav_msgs/msg/Path", _LAST),
        "obstacles": DerivedTopic("visualization_msgs/msg/MarkerArray", _LAST),
        "moving_obstacles": DerivedTopic("visualization_msgs/msg/MarkerArray", _LAST),
        "vehicle": DerivedTopic("visualization_msgs/msg/MarkerArray", _LAST),
        "occupied": DerivedTopic("sensor_msgs/msg/PointCloud2", _LAST),
    }
)
"""What is added to a recording, and to what a ROS 2 domain is shown of a flight."""


class DerivedMessages:
    """Makes the derived messages of one flight."""

    def __init__(self, spec: MissionSpec) -> None:
        self._counts = dict.fromkeys(DERIVED, 0)
        sources = (SensorMessages(spec), Visualization(spec))
        self._makers: Mapping[str, list[Callable[[int, Any], Iterator[tuple[str, Any]]]]] = {
            topic: [one.makers[topic] for one in sources if topic in one.makers] for topic in TOPICS
        }

    def of(self, sent: SentMessage) -> Iterator[SentMessage]:
        """The messages that are made once ``sent`` has come."""
        makers = self._makers.get(sent.topic, [])
        if not makers:
            return
        at_ns = sent.message.ready_ns
        try:
            message = decode(sent.message.payload, TOPICS[sent.topic].type)
            made = [one for maker in makers for one in maker(at_ns, message)]
        except MalformedMessageError:
            return
        for topic, derived in made:
            payload = encode(derived, DERIVED[topic].type)
            yield SentMessage(topic, Stamped(self._counts[topic], at_ns, payload))
            self._counts[topic] += 1
