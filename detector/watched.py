"""What a detector is shown: for each stage the monitored values of one check, column by column.

A check of perception is one row, one of planning a row for each point of the new trajectory, its sequence
numbers the same in every row. One of control is two rows: the row of the curve behind the tracked waypoint,
then the waypoint; both have the command that was made for it. All values are float64, SI units, world frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

_MOTION = tuple(f"trajectory.{name}" for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az"))
_COMMAND = ("command.vx", "command.vy", "command.vz", "command.yaw_rate")

CURVE = "curve"
"""Control's count of the curves (trajectories and stops) that it took up: where it changes the command may
jump. No state that a fault strikes."""

DURATION = "trajectory.duration"
"""Of a waypoint: time in s from the row before it."""

WATCHED: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "perception": ("collision_check.time_to_collision", "collision_check.future_collision_seq"),
        "planning": (
            "trajectory.t",
            *_MOTION,
            "trajectory.yaw",
            "trajectory.trajectory_seq",
            "trajectory.future_collision_seq",
        ),
        "control": (CURVE, DURATION, *_MOTION, *_COMMAND),
    }
)
"""Columns of a check by stage; what stands in ``services/bus/states.py`` has its name there."""
