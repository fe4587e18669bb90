"""Changes of the levels over a recorded flight: what the Gaussian and the autoencoder learn from.

What counts as a predecessor is the same here and in a flight: a point of a trajectory follows the point
before it, a sequence number that of the trajectory before it, and control's waypoint and command follow
those of the tick before unless another curve was taken up: there they may jump.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detector.preprocess import levels
from detector.series import Checks
from detector.watched import CURVE, WATCHED

CARRIED = frozenset({"trajectory.trajectory_seq", "trajectory.future_collision_seq"})
"""Columns of planning that have one value a trajectory, to be compared with the trajectory before."""


def changes(stage: str, checks: Checks, form: str = "folded") -> dict[str, NDArray[np.float64]]:
    """By state the changes of a flight, in order; the first of anything has none."""
    columns = {name: index for index, name in enumerate(WATCHED[stage]) if name != CURVE}
    made = {}
    for name, column in columns.items():
        values = checks.values[:, column]
        if name in CARRIED and stage == "planning":
            begins = checks.first[checks.first < len(values)]
            begins = begins[[index == 0 or begins[index - 1] != begin for index, begin in enumerate(begins)]]
            made[name] = np.diff(levels(name, values[begins], form))
        else:
            made[name] = np.diff(levels(name, values, form))[followed(stage, checks)]
    return made


def followed(stage: str, checks: Checks) -> NDArray[np.bool_]:
    """(rows - 1,) whether each row from the second on is compared with the row before it."""
    rows = max(len(checks.values) - 1, 0)
    if stage == "control":
        curve = checks.values[:, WATCHED[stage].index(CURVE)]
        return np.asarray(curve[1:] == curve[:-1])
    known = np.ones(rows + 1, dtype=bool)
    if stage == "planning":
        known[checks.first[checks.first <= rows]] = False
    return known[1:]
