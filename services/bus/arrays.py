"""Between messages (geometry, point clouds) and NumPy arrays. Quaternions are (w, x, y, z) in arrays."""

from __future__ import annotations

from math import atan2, inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.bus.message_checks import ALL_CHECKS, Checks, refuse
from services.bus.messages import (
    Header,
    MalformedMessageError,
    Odometry,
    Point,
    PointCloud2,
    PointField,
    Quaternion,
    Trajectory,
    Vector3,
)

Floats = NDArray[np.float64]

_FIELDS = [PointField(name, 4 * i, PointField.FLOAT32, 1) for i, name in enumerate("xyz")]


def vector(xyz: Floats) -> Vector3:
    """A Vector3 message of ``xyz`` (3,)."""
    return Vector3(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def point(xyz: Floats) -> Point:
    """A Point message of ``xyz`` (3,)."""
    return Point(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def quaternion(wxyz: Floats) -> Quaternion:
    """A Quaternion message of ``wxyz`` (4,)."""
    return Quaternion(x=float(wxyz[1]), y=float(wxyz[2]), z=float(wxyz[3]), w=float(wxyz[0]))


def xyz(message: Point | Vector3) -> Floats:
    """The (3,) array of a point or vector."""
    return np.array([message.x, message.y, message.z])


def wxyz(message: Quaternion) -> Floats:
    """The (4,) array of a quaternion."""
    return np.array([message.w, message.x, message.y, message.z])


def rotated(vector: Floats, rotation: Floats) -> Floats:
    """``vector`` (3,) turned by a unit quaternion (w, x, y, z).

    By a vehicle's attitude: from its body frame to the world frame; by the :func:`inverse`, back.
    """
    w, x, y, z = rotation.tolist()
    a, b, c = vector.tolist()
    # Twice the cross product of the quaternion's vector part with the vector: v + w t + (x, y, z) x t.
    i, j, k = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return np.array([a + w * i + y * k - z * j, b + w * j + z * i - x * k, c + w * k + x * j - y * i])


def turned(yaw: float) -> Floats:
    """The unit quaternion (w, x, y, z) of a turn to the left about the vertical, rad."""
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def inverse(rotation: Floats) -> Floats:
    """The unit quaternion (w, x, y, z) that turns back."""
    return rotation * (1.0, -1.0, -1.0, -1.0)


class VehicleState(NamedTuple):
    """The vehicle's state in the world frame: m, m/s, rad."""

    position: Floats
    velocity: Floats
    attitude: Floats
    yaw: float


FARTHEST_M = 10_000.0
FASTEST_M_S = 100.0
"""Odometry beyond these two is no measurement."""


def state(message: Odometry, checks: Checks = ALL_CHECKS) -> VehicleState:
    """The vehicle's state of an odometry message, in the world frame; its twist is in the body frame.

    :raises RefusedMessageError: if it is not finite, out of this world or its quaternion no rotation.
    """
    pose = message.pose.pose
    w, x, y, z = attitude = wxyz(pose.orientation)
    position, body_velocity = xyz(pose.position), xyz(message.twist.twist.linear)
    refuse(checks, "finite", "odometry: not finite", unless=_finite(position, body_velocity, attitude))
    # A comparison with NaN is false.
    possible = (
        np.abs(position).max() <= FARTHEST_M
        and np.abs(body_velocity).max() <= FASTEST_M_S
        and np.abs(attitude).max() < 2.0
        and abs(w * w + x * x + y * y + z * z - 1.0) < 0.01
    )
    refuse(checks, "range", "odometry: out of this world, or no rotation", unless=bool(possible))
    yaw = atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    return VehicleState(position, rotated(body_velocity, attitude), attitude, yaw)


def sound_goal(message: Any, checks: Checks = ALL_CHECKS) -> Any:
    """The goal message, checked: it is returned unchanged if it can be flown.

    :raises RefusedMessageError: if a coordinate is not finite or exceeds :data:`FARTHEST_M`.
    """
    _refuse_places(checks, "goal", xyz(message.position))
    return message


def sound_task(message: Any, checks: Checks = ALL_CHECKS) -> Any:
    """The task message, checked: it is returned unchanged if it makes sense.

    :raises RefusedMessageError: if a coordinate is not finite or exceeds :data:`FARTHEST_M`.
    """
    _refuse_places(checks, "task", *map(xyz, (message.start, message.lower, message.upper)))
    return message


def _refuse_places(checks: Checks, name: str, *places: Floats) -> None:
    refuse(checks, "finite", f"{name}: not finite", unless=_finite(*places))
    refuse(checks, "range", f"{name}: too far", unless=bool(np.abs(places).max() <= FARTHEST_M))


def _finite(*arrays: Floats) -> bool:
    return all(bool(np.isfinite(one).all()) for one in arrays)


class FlightPlace(NamedTuple):
    """Where a mission flies: its goal, and if it says so its start and area; (3,) each, world frame."""

    goal: Floats
    start: Floats
    lower: Floats
    upper: Floats


def place(goal: Any, task: Any) -> FlightPlace:
    """The place that a goal message and a task message or None give; without a task all is at the goal."""
    ends = [xyz(goal.position)] * 3 if task is None else [xyz(task.start), xyz(task.lower), xyz(task.upper)]
    return FlightPlace(xyz(goal.position), *ends)


POINT_FIELDS = 12
"""Numbers of one trajectory point: t, x y z, vx vy vz, ax ay az, yaw, blocking_yaw."""

POINTS_MAX = 8192
"""Of a trajectory: half an hour of flight."""


class Plan(NamedTuple):
    """A trajectory as stages work with it: ``points`` (n, 12), empty if there is no path."""

    trajectory_seq: int
    future_collision_seq: int
    points: Floats
    failed: bool


def plan(message: Any, checks: Checks = ALL_CHECKS) -> Plan:
    """The plan that a trajectory message holds.

    :raises MalformedMessageError: if its numbers are no whole points or too many.
    :raises RefusedMessageError: if they are not finite, or if its time runs backwards.
    """
    count, rest = divmod(message.points.size, POINT_FIELDS)
    if rest or count > POINTS_MAX:
        raise MalformedMessageError(f"trajectory: {message.points.size} numbers")
    points = message.points.reshape(-1, POINT_FIELDS)
    refuse(checks, "finite", "trajectory: not finite", unless=_finite(points))
    backwards = bool((points[1:, 0] < points[:-1, 0]).any())
    refuse(checks, "order", "trajectory: its time runs backwards", unless=not backwards)
    return Plan(message.trajectory_seq, message.future_collision_seq, points, bool(message.failed))


def plan_message(header: Header, made: Plan) -> Any:
    """The trajectory message that holds a plan."""
    return Trajectory(
        header=header,
        trajectory_seq=made.trajectory_seq,
        future_collision_seq=made.future_collision_seq,
        failed=made.failed,
        points=made.points.ravel(),
    )


NO_PLAN = Plan(0, 0, np.empty((0, POINT_FIELDS)), failed=False)
"""Before the first trajectory."""


class Verdict(NamedTuple):
    """What perception found on a trajectory; ``time_to_collision_s`` is ``inf`` for no collision."""

    checked_s: float
    trajectory_seq: int
    future_collision_seq: int
    time_to_collision_s: float


def verdict(message: Any, checks: Checks = ALL_CHECKS) -> Verdict:
    """The verdict that a collision check message holds.

    :raises RefusedMessageError: if its time to collision is no time: NaN or minus infinity.
    """
    stamp, left_s = message.header.stamp, message.time_to_collision
    refuse(checks, "finite", "collision check: no time", unless=left_s > -inf)
    checked_s = stamp.sec + stamp.nanosec / 1e9
    return Verdict(checked_s, message.trajectory_seq, message.future_collision_seq, left_s)


def cloud_message(header: Header, points: NDArray[np.float32]) -> PointCloud2:
    """A cloud of ``points`` (n, 3)."""
    return PointCloud2(
        header=header,
        height=1,
        width=len(points),
        fields=_FIELDS,
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=np.ascontiguousarray(points).reshape(-1).view(np.uint8),
        is_dense=True,
    )


def cloud_points(cloud: PointCloud2) -> NDArray[np.float32]:
    """The points (n, 3) of a cloud that :func:`cloud_message` made."""
    return cloud.data.view(np.float32).reshape(-1, len(_FIELDS))
