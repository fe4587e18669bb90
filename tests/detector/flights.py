"""Error-free flights made of formulas, as a detector would see them."""

import numpy as np
from numpy.typing import NDArray

from detector.series.monitored_states import WATCHED
from detector.series.series import Checks, Series

Floats = NDArray[np.float64]
STEP_S, TICK_S = 0.25, 0.04
COLUMNS = {stage: {name: index for index, name in enumerate(names)} for stage, names in WATCHED.items()}


def motion(t: Floats, phase: float = 0.0) -> Floats:
    """(n, 9) position, velocity and acceleration of a smooth curve at 1 to 2.6 m/s."""
    w, turn = 0.5, 0.5 * t + phase
    zero = np.zeros_like(t)
    position = (2.0 * t - 20.0, 3.0 * np.sin(turn), 3.0 + zero)
    velocity = (2.0 + zero, 3.0 * w * np.cos(turn), zero)
    acceleration = (zero, -3.0 * w**2 * np.sin(turn), zero)
    return np.stack((*position, *velocity, *acceleration), axis=1)


def planned(phase: float = 0.0, seq: int = 1, rows: int = 80) -> Floats:
    """One check of planning."""
    t = 1.0 + STEP_S * np.arange(float(rows))
    yaw = 0.3 * np.sin(0.3 * t)
    counts = np.tile((float(seq), float(seq - 1)), (rows, 1))
    return np.column_stack((t, motion(t, phase), yaw, counts))


def tracked(points: Floats, curve: float = 1.0) -> list[Floats]:
    """Checks of control that flies ``points`` from the first row's time on, the command its velocity."""
    checks = []
    for now in np.arange(points[0, 0], points[-1, 0], TICK_S):
        ahead = min(int(np.searchsorted(points[:, 0], now, side="right")), len(points) - 1)
        here = motion(np.array([now]))[0, :6]
        command = [*here[3:6], 0.1]
        rows = [[curve, STEP_S, *points[row, 1:10], *command, *here] for row in (ahead - 1, ahead)]
        checks.append(np.array(rows))
    return checks


def looked(checks: int = 40, found: int = 20) -> Floats:
    """(checks, 2) of perception that finds a collision once and loses it after three checks."""
    left = np.full(checks, np.inf)
    left[found : found + 3] = (3.1, 2.8, 2.5)
    return np.column_stack((left, (np.arange(checks) >= found).astype(float)))


def flight(phase: float = 0.0, seed: int = 0) -> Series:
    """A whole flight with two trajectories."""
    plans = [planned(phase, 1), planned(phase, 2)]
    ticks = tracked(plans[1])
    looks = looked()
    checks = {
        "perception": Checks(looks, np.arange(len(looks)), 0.3 * np.arange(float(len(looks)))),
        "planning": Checks(np.concatenate(plans), np.array([0, len(plans[0])]), np.array([0.5, 1.0])),
        "control": Checks(
            np.concatenate(ticks), 2 * np.arange(len(ticks)), 1.0 + TICK_S * np.arange(float(len(ticks)))
        ),
    }
    return Series(checks, {"spec": {"seed": seed}, "result": "success", "digest": "", "time_s": 21.0})
