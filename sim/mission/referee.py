"""The referee: when a mission ends, and how."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.models.outcome import MissionResult

GOAL_RADIUS_M = 1.0
"""How near to the goal the vehicle has to come: the goal lies well inside its safety body of 1.5 m."""

ARRIVAL_SPEED_M_S = 1.0
"""A trajectory ends at rest, so one that passes by is no arrival. The flight controller brings this
speed down to nothing within half a metre: what arrives so also stays within the goal radius."""


def arrived(goal: NDArray[np.float64], position: NDArray[np.float64], velocity: NDArray[np.float64]) -> bool:
    """Whether the vehicle has come to ``goal``: (3,) each, world frame, m and m/s."""
    near, slow = (
        np.linalg.norm(goal - position) <= GOAL_RADIUS_M,
        np.linalg.norm(velocity) <= ARRIVAL_SPEED_M_S,
    )
    return bool(near and slow)


def judge(
    time_limit_s: float,
    *,
    time_s: float,
    accomplished: bool,
    contact: bool,
    no_path: bool,
) -> MissionResult | None:
    """The mission's result, or None while it goes on.

    ``accomplished`` is the objective's word (``sim/mission/objective.py``), ``contact`` the
    physics', ``no_path`` the planner's that it gives up. Where several hold at one instant, a
    collision comes first (the paper counts a goal that is reached with one as a failure), then success.
    """
    if contact:
        return "collision"
    if accomplished:
        return "success"
    if no_path:
        return "no_path"
    if time_s >= time_limit_s:
        return "timeout"
    return None
