"""The status of a flight at a moment, for viewers; reading it changes nothing in the flight."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from pydantic import Field

from deploy.recording.recorder import FlightRecorder
from services.bus.arrays import rotated, wxyz, xyz
from services.bus.horizon import Stamped
from services.bus.messages import decode
from services.bus.topics import TOPICS
from services.models.base import Strict
from services.models.outcome import QoF


class FlightStatus(Strict):
    """Pose in the world frame, as the vehicle measures it, and quality of flight so far."""

    time_s: float = Field(description="virtual, since the beginning")
    twin: bool = Field(default=False, description="of the golden twin, which is flown first")
    position_m: tuple[float, float, float]
    orientation: tuple[float, float, float, float] = Field(description="quaternion (w, x, y, z)")
    velocity_m_s: tuple[float, float, float] = Field(description="world frame")
    command: tuple[float, float, float, float] | None = Field(
        default=None, description="last flight command: vx, vy, vz (m/s), yaw rate (rad/s)"
    )
    qof: QoF | None


def current_status(recorder: FlightRecorder, *, twin: bool) -> FlightStatus | None:
    """The status by the last messages; None before the first, and where they hold no finite numbers."""
    odometry = recorder.last("odometry")
    if odometry is None:
        return None
    return _status(odometry, recorder.last("mission"), recorder.last("command"), twin=twin)


def series(messages: Mapping[str, Sequence[Stamped]]) -> list[FlightStatus]:
    """The status of a whole flight, tick by tick, from its messages by topic."""
    found: list[FlightStatus] = []
    mission, command = _Newest(messages["mission"]), _Newest(messages["command"])
    for odometry in messages["odometry"]:
        now_ns = odometry.ready_ns
        status = _status(odometry, mission.at(now_ns), command.at(now_ns), twin=False)
        if status is not None:
            found.append(status)
    return found


class _Newest:
    """The newest message of a topic as time goes on."""

    def __init__(self, messages: Sequence[Stamped]) -> None:
        self._to_come = iter(messages)
        self._next = next(self._to_come, None)
        self._newest: Stamped | None = None

    def at(self, now_ns: int) -> Stamped | None:
        """The newest message that is ready; None before the first."""
        while self._next is not None and self._next.ready_ns <= now_ns:
            self._newest, self._next = self._next, next(self._to_come, None)
        return self._newest


def _command(command: Stamped | None) -> tuple[float, float, float, float] | None:
    """The command of a flight command message; None if there is none, or none of finite numbers."""
    if command is None:
        return None
    twist = decode(command.payload, TOPICS["command"].type).twist
    asked = (twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z)
    return asked if all(map(math.isfinite, asked)) else None


def _status(
    odometry: Stamped, mission: Stamped | None, command: Stamped | None, *, twin: bool
) -> FlightStatus | None:
    message = decode(odometry.payload, TOPICS["odometry"].type)
    at, turned = message.pose.pose.position, message.pose.pose.orientation
    vx, vy, vz = rotated(xyz(message.twist.twist.linear), wxyz(turned)).tolist()
    numbers = (at.x, at.y, at.z, turned.w, turned.x, turned.y, turned.z, vx, vy, vz)
    if not all(map(math.isfinite, numbers)):
        return None
    qof = decode(mission.payload, TOPICS["mission"].type).qof if mission is not None else None
    return FlightStatus(
        time_s=odometry.ready_ns / 1e9,
        twin=twin,
        position_m=numbers[:3],
        orientation=numbers[3:7],
        velocity_m_s=numbers[7:],
        command=_command(command),
        qof=QoF.model_validate_json(qof) if qof else None,
    )
