"""What a detector is shown of an output: its monitored values, column by column.

The columns are those of ``detector/series/monitored_states.py``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from services.bus.arrays import POINT_FIELDS, Floats
from services.bus.messages import TwistStamped


def shown_verdict(message: Any) -> Floats:
    """(1, 2), of a CollisionCheck: time to collision and the count of collisions."""
    return np.array([[message.time_to_collision, message.future_collision_seq]], dtype=np.float64)


def shown_trajectory(message: Any) -> Floats:
    """(points, 13), of a Trajectory: t, position, velocity, acceleration, yaw; in each row both counts."""
    points = message.points.reshape(-1, POINT_FIELDS)[:, :11]
    counts = (float(message.trajectory_seq), float(message.future_collision_seq))
    return np.hstack((points, np.tile(counts, (len(points), 1))))


def shown_command(message: TwistStamped, curves: int, waypoints: Floats) -> Floats:
    """(2, 15): the count of curves, ``waypoints`` (the row behind and the tracked one), the command twice."""
    linear, turn = message.twist.linear, message.twist.angular.z
    flown = np.tile((linear.x, linear.y, linear.z, turn), (2, 1))
    return np.hstack((np.full((2, 1), float(curves)), waypoints, flown))
