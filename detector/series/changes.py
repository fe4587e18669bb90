"""Changes of the levels over a recorded flight: what the Gaussian and the autoencoder learn from.

What counts as a predecessor is the same here and in a flight: a point of a trajectory follows the point
before it, planned or tracked, a sequence number that of the trajectory before it, and a command that of the
tick before, unless control took up another curve: there it may jump.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detector.series.monitored_states import CURVE, WATCHED
from detector.series.preprocessing import FLOORS, levels
from detector.series.series import Checks

CARRIED = frozenset({"trajectory.trajectory_seq", "trajectory.future_collision_seq"})
"""Columns of planning that have one value a trajectory, to be compared with the trajectory before."""


def changes(stage: str, checks: Checks, form: str = "folded") -> dict[str, NDArray[np.float64]]:
    """By state the changes of a flight, in order; what has no predecessor has none.

    Control's commands count as unchanged there, so that all its states have one change a tick.
    """
    made = {}
    for column, name in enumerate(WATCHED[stage]):
        values = checks.values[:, column]
        if name not in FLOORS:  # no state that a fault strikes there
            continue
        if stage == "control":
            seen = levels(name, values, form).reshape(-1, 2)
            made[name] = seen[:, 1] - seen[:, 0]
            if name.startswith("command."):
                made[name][1:] = np.where(followed(stage, checks), np.diff(seen[:, 1]), 0.0)
        elif name in CARRIED:
            begins = [checks.rows(check).start for check in range(len(checks)) if not checks.empty(check)]
            made[name] = np.diff(levels(name, values[begins], form))
        else:
            made[name] = np.diff(levels(name, values, form))[followed(stage, checks)]
    return made


def followed(stage: str, checks: Checks) -> NDArray[np.bool_]:
    """Whether each row from the second on is compared with the row before it; of control, each check."""
    if stage == "control":
        curve = checks.values[1::2, WATCHED[stage].index(CURVE)]
        return np.asarray(curve[1:] == curve[:-1])
    known = np.ones(max(len(checks.values), 1), dtype=bool)
    if stage == "planning":
        known[checks.first[checks.first < len(known)]] = False
    return known[1:]
