"""Messages: ROS 2 CDR through one typestore, standard types and our own ``zenfi_msgs``.

``MESSAGES`` holds the .msg text of our types, from which a ROS 2 interface package can be made.
Standard types are imported from here so that a stage names its message classes in one place.
"""

from __future__ import annotations

from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.stores.ros2_jazzy import builtin_interfaces__msg__Time as Time
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Point as Point
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Pose as Pose
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__PoseWithCovariance as PoseWithCovariance
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Quaternion as Quaternion
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Twist as Twist
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__TwistStamped as TwistStamped
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__TwistWithCovariance as TwistWithCovariance
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Vector3 as Vector3
from rosbags.typesys.stores.ros2_jazzy import nav_msgs__msg__Odometry as Odometry
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__CameraInfo as CameraInfo
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Image as Image
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointField as PointField
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__RegionOfInterest as RegionOfInterest
from rosbags.typesys.stores.ros2_jazzy import std_msgs__msg__Header as Header

__all__ = [
    "Alarm",
    "CameraInfo",
    "CollisionCheck",
    "Goal",
    "Header",
    "Image",
    "ImuBatch",
    "Injection",
    "MalformedMessageError",
    "Mission",
    "Octomap",
    "Odometry",
    "Point",
    "PointCloud2",
    "PointField",
    "Pose",
    "PoseWithCovariance",
    "Quaternion",
    "RegionOfInterest",
    "Task",
    "Time",
    "Trajectory",
    "Twist",
    "TwistStamped",
    "TwistWithCovariance",
    "Vector3",
    "decode",
    "definition",
    "encode",
    "header",
    "type_hash",
]

MESSAGES = {
    # What the IMU measured since the batch before, sample by sample x y z: rad/s and m/s^2 in the body
    # frame. At 190 Hz a message for each sample would cost a flight more than its physics.
    "zenfi_msgs/msg/ImuBatch": """
        std_msgs/Header header
        int64[] time_ns
        float64[] angular_velocity
        float64[] linear_acceleration
    """,
    # How the mission stands, sent by the simulator once a second and at its end: `result` is
    # "flying" or a MissionResult, `qof` the JSON of services.models.outcome.QoF.
    "zenfi_msgs/msg/Mission": """
        std_msgs/Header header
        string result
        string qof
    """,
    # Where to fly, and the space that may be flown in.
    "zenfi_msgs/msg/Goal": """
        std_msgs/Header header
        geometry_msgs/Point position
        geometry_msgs/Point lower
        geometry_msgs/Point upper
    """,
    # What a mission other than navigation is about beside its goal: where it starts, and the opposite
    # corners of the area that it covers. Their height is that of the flight.
    "zenfi_msgs/msg/Task": """
        std_msgs/Header header
        geometry_msgs/Point start
        geometry_msgs/Point lower
        geometry_msgs/Point upper
    """,
    # Verdict on the rest of the present trajectory (facts page, "collision check").
    "zenfi_msgs/msg/CollisionCheck": """
        std_msgs/Header header
        uint32 trajectory_seq
        uint32 future_collision_seq
        bool collision
        float64 time_to_collision
    """,
    # The paper's `multidoftraj`: row by row t, x y z, vx vy vz, ax ay az, yaw, blocking_yaw.
    # An empty trajectory says that no path was found; `failed` that the planner gave the mission up.
    "zenfi_msgs/msg/Trajectory": """
        std_msgs/Header header
        uint32 trajectory_seq
        uint32 future_collision_seq
        bool failed
        float64[] points
    """,
    # What the injector did. `record` is the JSON of services.models.outcome.InjectionRecord.
    "zenfi_msgs/msg/Injection": """
        string record
    """,
    # What was found wrong with an output: the JSON of services.models.detection.AlarmRecord. In recordings
    # only.
    "zenfi_msgs/msg/Alarm": """
        string record
    """,
    "octomap_msgs/msg/Octomap": """
        std_msgs/Header header
        bool binary
        string id
        float64 resolution
        int8[] data
    """,
}

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
for _name, _text in MESSAGES.items():
    TYPESTORE.register(get_types_from_msg("\n".join(map(str.strip, _text.splitlines())), _name))

Goal = TYPESTORE.types["zenfi_msgs/msg/Goal"]
ImuBatch = TYPESTORE.types["zenfi_msgs/msg/ImuBatch"]
Injection = TYPESTORE.types["zenfi_msgs/msg/Injection"]
Mission = TYPESTORE.types["zenfi_msgs/msg/Mission"]
Task = TYPESTORE.types["zenfi_msgs/msg/Task"]
Alarm = TYPESTORE.types["zenfi_msgs/msg/Alarm"]
CollisionCheck = TYPESTORE.types["zenfi_msgs/msg/CollisionCheck"]
Trajectory = TYPESTORE.types["zenfi_msgs/msg/Trajectory"]
Octomap = TYPESTORE.types["octomap_msgs/msg/Octomap"]


class MalformedMessageError(ValueError):
    """Bytes on the bus that are not a message of the type that their topic declares."""


def encode(message: Any, message_type: str) -> bytes:
    """Encode ``message`` as CDR bytes."""
    return bytes(TYPESTORE.serialize_cdr(message, message_type))


def decode(payload: bytes, message_type: str) -> Any:
    """The message in ``payload``; arrays are views into it.

    :raises MalformedMessageError: if the bytes are too few or make no sense for the type.
    """
    try:
        return TYPESTORE.deserialize_cdr(payload, message_type)
    except (SerdeError, UnicodeDecodeError, ValueError, IndexError, MemoryError) as error:
        message = f"{message_type}: {error}"
        raise MalformedMessageError(message) from error


def prepare(message_type: str) -> None:
    """Have the code made that encodes and decodes a type, instead of when it is first used."""
    TYPESTORE.get_msgdef(message_type)


def header(stamp_ns: int, frame_id: str) -> Header:
    """A header with a virtual-time stamp."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def definition(message_type: str) -> str:
    """The text of a type's .msg file, without comments; names of other types have their package."""
    whole: str = TYPESTORE.generate_msgdef(message_type, ros_version=2)[0]
    return whole.partition("=" * 80)[0].strip()


def type_hash(message_type: str) -> str:
    """The RIHS01 hash of a type, as it stands in rmw_zenoh's keys."""
    return TYPESTORE.hash_rihs01(message_type)
