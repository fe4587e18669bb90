"""Worlds made for one test: given boxes, start and goal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim.world import World

FAR_AWAY = (900.0, 900.0, 0.0, 903.0, 903.0, 20.0)


def world_with(
    *boxes: Sequence[float],
    start: Sequence[float] = (0.0, 0.0, 5.0),
    goal: Sequence[float] = (50.0, 0.0, 5.0),
) -> World:
    return World(
        name="test",
        seed=0,
        bounds=np.array([[-1000.0, -1000.0, 0.0], [1000.0, 1000.0, 500.0]]),
        obstacles=np.array(boxes or (FAR_AWAY,), dtype=np.float64),
        start=np.array(start, dtype=np.float64),
        goal=np.array(goal, dtype=np.float64),
    )
