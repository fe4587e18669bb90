"""Sensors that fail: what is published instead of what was measured, in the seven ways of PX4."""

from __future__ import annotations

from collections import deque
from copy import copy
from math import inf
from typing import Any, NamedTuple

import numpy as np

from services.bus.arrays import point, quaternion, vector, wxyz, xyz
from services.bus.messages import decode, encode
from services.bus.topics import TOPICS
from services.models.faults.specification import FaultSpec
from services.models.outcome import InjectionRecord
from services.runtime.rng import generator

GARBAGE_M = 100.0
GARBAGE_M_S = 20.0
"""Garbage is drawn uniformly up to these: as if it came from a vehicle, but any."""


class Published(NamedTuple):
    """What becomes of a message: what is published, None for nothing, and the record if it was changed."""

    message: Any | None
    record: InjectionRecord | None = None


class SensorFault:
    """One sensor that fails between two times.

    ``off``: nothing is published. ``stuck``: the last values before, with new stamps. ``garbage``: values
    drawn anew. ``wrong``: depth and IMU multiplied by ``size``, a position moved by ``size`` m along x.
    ``slow``: one message in ``size`` s. ``delayed``: what was measured ``size`` s ago. ``intermittent``:
    nothing, with a probability, for each message alone.
    """

    def __init__(self, fault: FaultSpec, mission_seed: int) -> None:
        self.topic = fault.target
        self._fault = fault
        self._seed = mission_seed
        self._until_s = inf if fault.until_s is None else fault.until_s
        self._number = -1
        self._before: Any = None
        self._past: deque[tuple[int, Any]] = deque()
        self._last_ns = -inf

    def publish(self, message: Any, now_ns: int) -> Published:
        """What is published in place of ``message``, the sensor's next."""
        self._number += 1
        instead = self._instead(message, now_ns)
        if instead is message:
            self._before, self._last_ns = message, now_ns
            return Published(message)
        record = InjectionRecord(
            status="injected",
            precision="exact",
            node="sim",
            kernel="",
            invocation=self._number,
            state=[self.topic],
            model=self._fault.model,
            virtual_time_ns=now_ns,
            before=self._told(message),
            after=self._told(instead),
            read_back=self._told(self._again(instead)),
            trigger=self._fault.trigger,
        )
        return Published(instead, record)

    def _instead(self, message: Any, now_ns: int) -> Any | None:
        fault = self._fault
        if fault.model == "delayed":
            self._past.append((now_ns, message))
        if not fault.from_s * 1e9 <= now_ns < self._until_s * 1e9:
            return message
        draw = generator(self._seed, f"sensor {self.topic}", fault.seed, self._number)
        if self._missing(now_ns, draw):
            return None
        if fault.model == "delayed":
            return self._delayed(now_ns - round((fault.size or 0.0) * 1e9))
        if fault.model == "stuck":
            self._before = message if self._before is None else self._before
            return _with_header(self._before, message.header)
        change = _CHANGES.get((self.topic, fault.model))
        return message if change is None else change(message, draw, fault.size or 0.0)

    def _missing(self, now_ns: int, draw: np.random.Generator) -> bool:
        """Whether nothing is published."""
        fault = self._fault
        if fault.model == "slow":
            return now_ns - self._last_ns < (fault.size or 0.0) * 1e9
        if fault.model == "intermittent":
            return bool(draw.random() < (fault.probability or 0.0))
        return fault.model == "off"

    def _delayed(self, measured_ns: int) -> Any | None:
        """The newest message that is old enough; None if there is none yet."""
        while len(self._past) > 1 and self._past[1][0] <= measured_ns:
            self._past.popleft()
        at_ns, message = self._past[0]
        return message if at_ns <= measured_ns else None

    def _again(self, message: Any | None) -> Any | None:
        """The message as a subscriber reads it."""
        kind = TOPICS[self.topic].type
        return None if message is None else decode(encode(message, kind), kind)

    def _told(self, message: Any | None) -> str:
        """A message in words: what matters of it to a reader of the record."""
        if message is None:
            return "nothing"
        return _WORDS[self.topic](message)


def _with_header(message: Any, header: Any) -> Any:
    changed = copy(message)
    changed.header = header
    return changed


def _depth_of(message: Any) -> Any:
    return message.data.view(np.float32)


def _with_depth(message: Any, depth: Any) -> Any:
    changed = copy(message)
    changed.data = depth.astype(np.float32).view(np.uint8)
    return changed


def _garbage_depth(message: Any, draw: np.random.Generator, _: float) -> Any:
    return _with_depth(message, draw.uniform(0.0, GARBAGE_M, len(_depth_of(message))))


def _wrong_depth(message: Any, _: np.random.Generator, size: float) -> Any:
    return _with_depth(message, _depth_of(message) * size)


def _with_pose(message: Any, position: Any, attitude: Any, velocity: Any) -> Any:
    changed = copy(message)
    changed.pose, changed.twist = copy(message.pose), copy(message.twist)
    changed.pose.pose, changed.twist.twist = copy(message.pose.pose), copy(message.twist.twist)
    changed.pose.pose.position = point(position)
    changed.pose.pose.orientation = quaternion(attitude)
    changed.twist.twist.linear = vector(velocity)
    return changed


def _garbage_odometry(message: Any, draw: np.random.Generator, _: float) -> Any:
    attitude = draw.standard_normal(4)
    return _with_pose(
        message,
        draw.uniform(-GARBAGE_M, GARBAGE_M, 3),
        attitude / np.linalg.norm(attitude),
        draw.uniform(-GARBAGE_M_S, GARBAGE_M_S, 3),
    )


def _wrong_odometry(message: Any, _: np.random.Generator, size: float) -> Any:
    pose = message.pose.pose
    moved = xyz(pose.position) + np.array([size, 0.0, 0.0])
    return _with_pose(message, moved, wxyz(pose.orientation), xyz(message.twist.twist.linear))


def _garbage_imu(message: Any, draw: np.random.Generator, _: float) -> Any:
    changed = copy(message)
    changed.angular_velocity = draw.uniform(-GARBAGE_M_S, GARBAGE_M_S, len(message.angular_velocity))
    changed.linear_acceleration = draw.uniform(-GARBAGE_M, GARBAGE_M, len(message.linear_acceleration))
    return changed


def _wrong_imu(message: Any, _: np.random.Generator, size: float) -> Any:
    changed = copy(message)
    changed.angular_velocity = message.angular_velocity * size
    changed.linear_acceleration = message.linear_acceleration * size
    return changed


_CHANGES = {
    ("depth", "garbage"): _garbage_depth,
    ("depth", "wrong"): _wrong_depth,
    ("odometry", "garbage"): _garbage_odometry,
    ("odometry", "wrong"): _wrong_odometry,
    ("imu", "garbage"): _garbage_imu,
    ("imu", "wrong"): _wrong_imu,
}


def _depth_in_words(message: Any) -> str:
    seen = _depth_of(message)
    seen = seen[np.isfinite(seen)]
    return f"{len(seen)} pixels, mean {seen.mean():.6g} m" if len(seen) else "no pixels"


def _pose_in_words(message: Any) -> str:
    position, velocity = xyz(message.pose.pose.position), xyz(message.twist.twist.linear)
    return f"{_numbers(position)} m, {_numbers(velocity)} m/s"


def _imu_in_words(message: Any) -> str:
    if not len(message.time_ns):
        return "no samples"
    rates, force = message.angular_velocity[:3], message.linear_acceleration[:3]
    return f"{_numbers(rates)} rad/s, {_numbers(force)} m/s^2"


def _numbers(values: Any) -> str:
    return " ".join(f"{value:.6g}" for value in values)


_WORDS = {"depth": _depth_in_words, "odometry": _pose_in_words, "imu": _imu_in_words}
