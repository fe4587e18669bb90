"""How a flight stands at a moment, for who watches: looking changes nothing in it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from pydantic import Field

from deploy.recorder import Recorder
from services.bus.arrays import rotated, wxyz, xyz
from services.bus.horizon import Stamped
from services.bus.messages import decode
from services.bus.model import Strict
from services.bus.outcome import QoF
from services.bus.topics import TOPICS


class Present(Strict):
    """Pose in the world frame, as the vehicle tells it, and quality of flight so far."""

    time_s: float = Field(description="virtual, since the beginning")
    twin: bool = Field(default=False, description="of the golden twin, which is flown first")
    position_m: tuple[float, float, float]
    orientation: tuple[float, float, float, float] = Field(description="quaternion (w, x, y, z)")
    velocity_m_s: tuple[float, float, float] = Field(description="world frame")
    command: tuple[float, float, float, float] | None = Field(
        default=None, description="last flight command: vx, vy, vz (m/s), yaw rate (rad/s)"
    )
    qof: QoF | None


def present(recorder: Recorder, *, twin: bool) -> Present | None:
    """What the last messages tell; None before the first, and where they tell no finite numbers."""
    odometry = recorder.last("odometry")
    if odometry is None:
        return None
    return _told(odometry, recorder.last("mission"), recorder.last("command"), twin=twin)


def series(messages: Mapping[str, Sequence[Stamped]]) -> list[Present]:
    """A whole flight, tick by tick, from its messages by topic."""
    found: list[Present] = []
    mission, command = _Newest(messages["mission"]), _Newest(messages["command"])
    for odometry in messages["odometry"]:
        now_ns = odometry.ready_ns
        told = _told(odometry, mission.at(now_ns), command.at(now_ns), twin=False)
        if told is not None:
            found.append(told)
    return found


class _Newest:
    """The newest message of a topic as time goes on."""

    def __init__(self, messages: Sequence[Stamped]) -> None:
        self._to_come = iter(messages)
        self._next = next(self._to_come, None)
        self._newest: Stamped | None = None

    def at(self, now_ns: int) -> Stamped | None:
        """The newest that is ready; None before the first."""
        while self._next is not None and self._next.ready_ns <= now_ns:
            self._newest, self._next = self._next, next(self._to_come, None)
        return self._newest


def _command(command: Stamped | None) -> tuple[float, float, float, float] | None:
    """What the flight command asks for; None if there is none, or none of finite numbers."""
    if command is None:
        return None
    twist = decode(command.payload, TOPICS["command"].type).twist
    asked = (twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z)
    return asked if all(map(math.isfinite, asked)) else None


def _told(
    odometry: Stamped, mission: Stamped | None, command: Stamped | None, *, twin: bool
) -> Present | None:
    told = decode(odometry.payload, TOPICS["odometry"].type)
    at, turned = told.pose.pose.position, told.pose.pose.orientation
    vx, vy, vz = rotated(xyz(told.twist.twist.linear), wxyz(turned)).tolist()
    numbers = (at.x, at.y, at.z, turned.w, turned.x, turned.y, turned.z, vx, vy, vz)
    if not all(map(math.isfinite, numbers)):
        return None
    qof = decode(mission.payload, TOPICS["mission"].type).qof if mission is not None else None
    return Present(
        time_s=odometry.ready_ns / 1e9,
        twin=twin,
        position_m=numbers[:3],
        orientation=numbers[3:7],
        velocity_m_s=numbers[7:],
        command=_command(command),
        qof=QoF.model_validate_json(qof) if qof else None,
    )
