"""Backup controller: straight to a waypoint, no faster than a limit, or a hover if that makes no sense.

Run-time assurance (ASTM F3269): a detector watches the controller that is too complex to be trusted, and on
its alarm the command comes from here. It has no state and one branch, so that what it commands is bounded for
whatever it is given.
"""

from __future__ import annotations

import numpy as np

from services.bus.arrays import Floats

GAIN_1_S = 1.0
"""Commanded speed by distance, in 1/s: well below what the airframe follows."""


def simple_command(position: Floats, waypoint: Floats, speed_m_s: float) -> Floats:
    """The command (4,): velocity, m/s, world frame, at most ``speed_m_s`` fast, and no yaw rate.

    ``position`` and ``waypoint`` (3,) are in m, world frame.
    """
    command = np.zeros(4)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.asarray(waypoint, dtype=np.float64) - position
        distance = np.linalg.norm(off)
    if np.isfinite(distance):
        command[:3] = off * min(GAIN_1_S, speed_m_s / max(float(distance), 1e-9))
    return command
