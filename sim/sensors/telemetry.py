"""Sensor messages of the simulated vehicle."""

from __future__ import annotations

from typing import Any

import numpy as np

from services.bus.arrays import inverse, point, quaternion, rotated, vector
from services.bus.frames import BASE_LINK
from services.bus.messages import (
    CameraInfo,
    Goal,
    Header,
    Image,
    ImuBatch,
    Odometry,
    Pose,
    PoseWithCovariance,
    RegionOfInterest,
    Task,
    Twist,
    TwistWithCovariance,
)
from sim.sensors.camera import DepthCamera
from sim.sensors.imu import ImuSamples
from sim.sensors.odometry import Drift
from sim.vehicle.vehicle import Floats, Vehicle
from sim.world import World

EXACT_VARIANCE = 1e-9
"""Stated of what is measured exactly: estimators take a variance of zero for "unknown"."""

_EXACT = np.diag(np.full(6, EXACT_VARIANCE)).ravel()
_POSITION = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]).ravel()


def odometry(header: Header, vehicle: Vehicle, drift: Drift) -> Odometry:
    """Pose in the odometry frame, twist in the body frame (REP 105); covariances as the drift has them."""
    attitude = vehicle.quaternion
    pose = Pose(position=point(vehicle.position + drift.offset), orientation=quaternion(attitude))
    linear = rotated(vehicle.velocity, inverse(attitude))
    twist = Twist(linear=vector(linear), angular=vector(vehicle.body_rates))
    covariance = _EXACT if not drift.variance_m2 else _EXACT + _POSITION * drift.variance_m2
    return Odometry(
        header=header,
        child_frame_id=BASE_LINK,
        pose=PoseWithCovariance(pose=pose, covariance=covariance),
        twist=TwistWithCovariance(twist=twist, covariance=_EXACT),
    )


def imu(header: Header, samples: ImuSamples) -> Any:
    """What the IMU measured in the tick that ends now."""
    return ImuBatch(
        header=header,
        time_ns=samples.time_ns,
        angular_velocity=samples.rates.ravel(),
        linear_acceleration=samples.force.ravel(),
    )


def depth_image(header: Header, camera: DepthCamera, vehicle: Vehicle) -> Image:
    """What the depth camera sees, encoding 32FC1."""
    depth = camera.render(vehicle)
    return Image(
        header=header,
        height=camera.height,
        width=camera.width,
        encoding="32FC1",
        is_bigendian=0,
        step=4 * camera.width,
        data=depth.reshape(-1).view(np.uint8),
    )


def camera_info(header: Header, camera: DepthCamera) -> CameraInfo:
    """The camera's intrinsics: an ideal pinhole."""
    intrinsics = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1.0])
    return CameraInfo(
        header=header,
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=intrinsics,
        r=np.eye(3).ravel(),
        p=np.insert(intrinsics, [3, 6, 9], 0.0),
        binning_x=0,
        binning_y=0,
        roi=RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def goal(header: Header, world: World) -> Any:
    """Where to fly, and the space that may be flown in."""
    return Goal(
        header=header,
        position=point(world.goal),
        lower=point(world.bounds[0]),
        upper=point(world.bounds[1]),
    )


def task(header: Header, world: World, area: Floats) -> Any:
    """Where the mission starts, and the corners (2, 3) of the area that it covers."""
    return Task(header=header, start=point(world.start), lower=point(area[0]), upper=point(area[1]))
