"""The input of detectors: for each stage the monitored values of one check, column by column.

A check of perception is one row, one of planning a row for each point of the new trajectory, its sequence
numbers the same in every row. One of control is two rows: the row of the curve behind the tracked waypoint,
then the waypoint; both have the command that was made for it, and the odometry that this was made from. All
values are float64, SI units, world frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

_MOTION = tuple(f"trajectory.{name}" for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az"))
_MEASURED = tuple(f"odometry.{name}" for name in ("x", "y", "z", "vx", "vy", "vz"))
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
        "control": (CURVE, DURATION, *_MOTION, *_COMMAND, *_MEASURED),
    }
)
"""Columns of a check by stage; a state of ``services/models/inter_kernel_states.py`` has its name there."""

ROWS: Mapping[str, int | None] = MappingProxyType({"perception": 1, "planning": None, "control": 2})
"""Rows of a check, None for any number."""


def as_check(stage: str, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """The check (rows, columns) that ``numbers`` hold row by row: what schemes, which trust its shape, take.

    :raises ValueError: if there is no such stage, or they are no whole rows of it.
    """
    if stage not in WATCHED:
        message = f"no stage {stage!r} is watched"
        raise ValueError(message)
    rows, rest = divmod(numbers.size, len(WATCHED[stage]))
    if rest or ROWS[stage] not in (None, rows):
        message = f"{numbers.size} numbers are no check of {stage}"
        raise ValueError(message)
    return np.ascontiguousarray(numbers, dtype=np.float64).reshape(rows, len(WATCHED[stage]))
