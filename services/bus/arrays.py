"""Between the small geometry messages and NumPy arrays. Quaternions are (w, x, y, z) in arrays."""

from __future__ import annotations

from math import atan2
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.bus.messages import Header, Odometry, Point, Quaternion, Trajectory, Vector3

Floats = NDArray[np.float64]


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


class State(NamedTuple):
    """The vehicle's state in the world frame: m, m/s, rad."""

    position: Floats
    velocity: Floats
    attitude: Floats
    yaw: float


def state(message: Odometry) -> State:
    """What odometry says; its linear velocity is in the world frame."""
    pose = message.pose.pose
    w, x, y, z = attitude = wxyz(pose.orientation)
    yaw = atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    return State(xyz(pose.position), xyz(message.twist.twist.linear), attitude, yaw)


class Place(NamedTuple):
    """Where a mission flies: its goal, and if it says so its start and area; (3,) each, world frame."""

    goal: Floats
    start: Floats
    lower: Floats
    upper: Floats


def place(goal: Any, task: Any) -> Place:
    """What a goal message and a task message, or None, say; without a task all is at the goal."""
    ends = [xyz(goal.position)] * 3 if task is None else [xyz(task.start), xyz(task.lower), xyz(task.upper)]
    return Place(xyz(goal.position), *ends)


POINT_FIELDS = 12
"""Numbers of one trajectory point: t, x y z, vx vy vz, ax ay az, yaw, blocking_yaw."""


class Plan(NamedTuple):
    """A trajectory as stages work with it: ``points`` (n, 12), empty if there is no path."""

    trajectory_seq: int
    future_collision_seq: int
    points: Floats
    failed: bool


def plan(message: Any) -> Plan:
    """What a trajectory message says; empty if its numbers are no whole points."""
    whole = message.points.size % POINT_FIELDS == 0
    points = message.points if whole else np.empty(0)
    return Plan(
        message.trajectory_seq,
        message.future_collision_seq,
        points.reshape(-1, POINT_FIELDS),
        bool(message.failed),
    )


def plan_message(header: Header, made: Plan) -> Any:
    """The message of a plan."""
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


def verdict(message: Any) -> Verdict:
    """What a collision check says."""
    stamp = message.header.stamp
    checked_s = stamp.sec + stamp.nanosec / 1e9
    return Verdict(checked_s, message.trajectory_seq, message.future_collision_seq, message.time_to_collision)
