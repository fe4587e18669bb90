"""The referee: when a mission ends, and how."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.bus.outcome import MissionResult

GOAL_RADIUS_M = 1.0
"""How near to the goal the vehicle has to come: the goal lies well inside its safety body of 1.5 m."""

ARRIVAL_SPEED_M_S = 1.0
"""A trajectory ends at rest, so one that passes by is no arrival. The flight controller brings this
speed down to nothing within half a metre: what arrives so also stays within the goal radius."""


def judge(
    goal: NDArray[np.float64],
    time_limit_s: float,
    *,
    time_s: float,
    position: NDArray[np.float64],
    velocity: NDArray[np.float64],
    contact: bool,
    no_path: bool,
) -> MissionResult | None:
    """The mission's result, or None while it goes on.

    ``goal``, ``position`` in m and ``velocity`` in m/s are (3,) in the world frame; ``contact`` is the
    physics' word, ``no_path`` the planner's that it gives up. Where several hold at one instant, a
    collision comes first (the paper counts a goal that is reached with one as a failure), then success.
    """
    if contact:
        return "collision"
    if np.linalg.norm(goal - position) <= GOAL_RADIUS_M and np.linalg.norm(velocity) <= ARRIVAL_SPEED_M_S:
        return "success"
    if no_path:
        return "no_path"
    if time_s >= time_limit_s:
        return "timeout"
    return None
