"""Standard ROS messages of a flight: transforms, pose, IMU, battery, diagnostics and trajectory."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from math import inf, nan
from typing import Any

import numpy as np
from rosbags.typesys.stores.ros2_jazzy import builtin_interfaces__msg__Duration as Duration
from rosbags.typesys.stores.ros2_jazzy import diagnostic_msgs__msg__DiagnosticArray as DiagnosticArray
from rosbags.typesys.stores.ros2_jazzy import diagnostic_msgs__msg__DiagnosticStatus as DiagnosticStatus
from rosbags.typesys.stores.ros2_jazzy import diagnostic_msgs__msg__KeyValue as KeyValue
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__PoseStamped as PoseStamped
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Transform as Transform
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__TransformStamped as TransformStamped
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__BatteryState as BatteryState
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Imu as Imu
from rosbags.typesys.stores.ros2_jazzy import tf2_msgs__msg__TFMessage as Transforms
from rosbags.typesys.stores.ros2_jazzy import trajectory_msgs__msg__MultiDOFJointTrajectory as JointTrajectory
from rosbags.typesys.stores.ros2_jazzy import (
    trajectory_msgs__msg__MultiDOFJointTrajectoryPoint as JointTrajectoryPoint,
)

from services.bus import frames
from services.bus.arrays import Floats, plan, quaternion, state, turned, vector, verdict
from services.bus.messages import Header, Twist, header
from services.models.mission import MissionSpec
from sim.vehicle.airframe import airframe

_OPTICAL = np.array([0.5, -0.5, 0.5, -0.5])
"""(w, x, y, z): takes the axes of the camera's optical frame to those of its link."""

_HERE, _LEVEL = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
_NOT_MEASURED = np.array([-1.0, *[0.0] * 8])
"""The covariance by which ``sensor_msgs/Imu`` says that there is no such measurement."""

_NOISELESS = 1e-9
"""A variance that stands for none: one of zero says "unknown" in ``sensor_msgs/Imu``."""


class SensorMessages:
    """Makes the standard messages of one flight: ``makers`` are by the topic from which they are made."""

    def __init__(self, spec: MissionSpec) -> None:
        self._airframe = airframe(spec.airframe).name
        self._rates_covariance = _variance(spec.imu.gyro_noise_rad_s)
        self._force_covariance = _variance(spec.imu.accel_noise_m_s2)
        self._collision_in_s = inf
        self._has_no_path = False
        self.makers: Mapping[str, Callable[[int, Any], Iterator[tuple[str, Any]]]] = {
            "goal": _mounted,
            "odometry": _moved,
            "imu": self._felt,
            "collision_check": self._checked,
            "trajectory": self._planned,
            "mission": self._health,
        }

    def _felt(self, _: int, batch: Any) -> Iterator[tuple[str, Any]]:
        rates, forces = batch.angular_velocity.reshape(-1, 3), batch.linear_acceleration.reshape(-1, 3)
        for time_ns, rate, force in zip(batch.time_ns.tolist(), rates, forces, strict=True):
            yield (
                "imu/data_raw",
                Imu(
                    header=header(time_ns, frames.BASE_LINK),
                    orientation=quaternion(_LEVEL),
                    orientation_covariance=_NOT_MEASURED,
                    angular_velocity=vector(rate),
                    angular_velocity_covariance=self._rates_covariance,
                    linear_acceleration=vector(force),
                    linear_acceleration_covariance=self._force_covariance,
                ),
            )

    def _checked(self, _: int, check: Any) -> Iterator[tuple[str, Any]]:
        self._collision_in_s = verdict(check).time_to_collision_s
        yield from ()

    def _planned(self, at_ns: int, trajectory: Any) -> Iterator[tuple[str, Any]]:
        """Times count from that of the first point, which is the header's stamp."""
        rows = [row for row in plan(trajectory).points if 0.0 <= row[0] < 2**31]
        self._has_no_path = bool(trajectory.failed)
        begin_ns = round(rows[0][0] * 1e9) if rows else at_ns
        yield (
            "planned_trajectory",
            JointTrajectory(
                header=header(begin_ns, frames.MAP),
                joint_names=[frames.BASE_LINK],
                points=[_trajectory_point(row, begin_ns) for row in rows],
            ),
        )

    def _health(self, at_ns: int, mission: Any) -> Iterator[tuple[str, Any]]:
        qof = json.loads(mission.qof)
        yield "battery", _battery(header(at_ns, frames.BASE_LINK), qof["state_of_charge"])
        going = mission.result in ("flying", "success")
        statuses = [
            self._status(
                "mission", mission.result, DiagnosticStatus.OK if going else DiagnosticStatus.ERROR, qof
            )
        ]
        if self._has_no_path:
            statuses.append(self._status("planning", "no path", DiagnosticStatus.ERROR, {}))
        if self._collision_in_s < inf:
            found = {"time_to_collision_s": self._collision_in_s}
            statuses.append(self._status("perception", "collision ahead", DiagnosticStatus.WARN, found))
        yield "diagnostics", DiagnosticArray(header=header(at_ns, ""), status=statuses)

    def _status(self, name: str, message: str, level: int, values: Mapping[str, Any]) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=level,
            name=f"zenfi: {name}",
            message=message,
            hardware_id=self._airframe,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )


def _variance(deviation: float) -> Floats:
    return (np.eye(3) * max(deviation**2, _NOISELESS)).ravel()


def _mounted(at_ns: int, _: Any) -> Iterator[tuple[str, Any]]:
    """What does not move: odometry's origin in the map, and the camera on the vehicle."""
    yield (
        "tf_static",
        Transforms(
            transforms=[
                _transform(header(at_ns, frames.MAP), frames.ODOM, _HERE, _LEVEL),
                _transform(header(at_ns, frames.BASE_LINK), frames.CAMERA_LINK, _HERE, _LEVEL),
                _transform(header(at_ns, frames.CAMERA_LINK), frames.CAMERA_OPTICAL, _HERE, _OPTICAL),
            ]
        ),
    )


def _moved(_: int, odometry: Any) -> Iterator[tuple[str, Any]]:
    is_at = state(odometry)  # refuses what is no pose
    moved = _transform(odometry.header, odometry.child_frame_id, is_at.position, is_at.attitude)
    yield "tf", Transforms(transforms=[moved])
    yield "pose", PoseStamped(header=odometry.header, pose=odometry.pose.pose)


def _transform(parent: Header, child: str, position: Floats, attitude: Floats) -> TransformStamped:
    transform = Transform(translation=vector(position), rotation=quaternion(attitude))
    return TransformStamped(header=parent, child_frame_id=child, transform=transform)


def _trajectory_point(row: Floats, begin_ns: int) -> JointTrajectoryPoint:
    seconds, nanoseconds = divmod(round(row[0] * 1e9) - begin_ns, 1_000_000_000)
    return JointTrajectoryPoint(
        transforms=[Transform(translation=vector(row[1:4]), rotation=quaternion(turned(row[10])))],
        velocities=[Twist(linear=vector(row[4:7]), angular=vector(_HERE))],
        accelerations=[Twist(linear=vector(row[7:10]), angular=vector(_HERE))],
        time_from_start=Duration(sec=seconds, nanosec=nanoseconds),
    )


def _battery(at: Header, state_of_charge: float) -> BatteryState:
    """Only the charge is known; what is not is NaN, as the message has it."""
    return BatteryState(
        header=at,
        voltage=nan,
        temperature=nan,
        current=nan,
        charge=nan,
        capacity=nan,
        design_capacity=nan,
        percentage=state_of_charge,
        power_supply_status=BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
        power_supply_health=BatteryState.POWER_SUPPLY_HEALTH_UNKNOWN,
        power_supply_technology=BatteryState.POWER_SUPPLY_TECHNOLOGY_UNKNOWN,
        present=True,
        cell_voltage=np.empty(0, dtype=np.float32),
        cell_temperature=np.empty(0, dtype=np.float32),
        location="",
        serial_number="",
    )
