"""The way that the vehicle came, by which it can fly back: nothing stood there a while ago."""

from __future__ import annotations

import numpy as np

from services.bus.arrays import Floats

SPACING_M = 0.5
"""Between two places that are kept."""


class Trail:
    """Places (3,) where the vehicle was, in m, world frame, at least ``SPACING_M`` apart."""

    def __init__(self) -> None:
        self._places: list[Floats] = []

    def add(self, position: Floats) -> None:
        """Keep where the vehicle is now, unless that is near the last place that was kept."""
        if not self._places or np.linalg.norm(position - self._places[-1]) >= SPACING_M:
            self._places.append(np.array(position, dtype=np.float64))

    def back(self, position: Floats, length_m: float) -> Floats | None:
        """The way back (n, 3) from a position, ``length_m`` long or to its beginning; None: there is none."""
        path, left_m = [np.array(position, dtype=np.float64)], length_m
        for place in reversed(self._places):
            step_m = float(np.linalg.norm(place - path[-1]))
            if step_m < SPACING_M / 2.0:
                continue
            if step_m > left_m:
                break
            path.append(place)
            left_m -= step_m
        return np.array(path) if len(path) > 1 else None
