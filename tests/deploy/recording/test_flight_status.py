"""What is shown of a flight while it flies."""

from math import cos, pi, sin

import numpy as np
import pytest

from deploy.recording.flight_status import series
from services.bus.arrays import point, quaternion, vector
from services.bus.horizon import Stamped
from services.bus.messages import (
    Odometry,
    Pose,
    PoseWithCovariance,
    Twist,
    TwistWithCovariance,
    encode,
    header,
)
from services.bus.topics import TOPICS

COVARIANCE = np.zeros(36)


def test_velocity_is_shown_in_the_world_frame() -> None:
    """A vehicle with its nose to the north that flies ahead moves north."""
    pose = Pose(point(np.zeros(3)), quaternion(np.array([cos(pi / 4), 0.0, 0.0, sin(pi / 4)])))
    twist = Twist(linear=vector(np.array([2.0, 0.0, 0.5])), angular=vector(np.zeros(3)))
    told = Odometry(
        header(0, "map"), "body", PoseWithCovariance(pose, COVARIANCE), TwistWithCovariance(twist, COVARIANCE)
    )
    odometry = [Stamped(0, 0, encode(told, TOPICS["odometry"].type))]
    (shown,) = series({"odometry": odometry, "mission": [], "command": []})
    assert shown.velocity_m_s == pytest.approx((0.0, 2.0, 0.5))
