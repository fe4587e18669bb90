"""Flying a trajectory waypoint after waypoint, each for as long as it lasts: the published way."""

# ruff: noqa: ARG002 - what is overridden keeps its parameters

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.control.follower import WAYPOINT_FIELDS, Follower
from services.control.pid import PACE
from services.models.pilots import Guards, Pilot


class WaypointFollower(Follower):
    """Holds each row of the newest trajectory for its duration, from the moment at which it came.

    A row lasts from its time to the next one's. Where the command that it asks for is faster than the limit,
    it is flown slower and longer by the same factor: the published system does so to cover the distance. A
    row that asks for nonsense is so held for as long. After the last row, and to stop, the vehicle hovers.
    """

    def __init__(self, pilot: Pilot, guards: Guards) -> None:
        super().__init__(pilot, guards)
        self._rows: NDArray[np.float64] | None = None
        self._seq: int | None = None
        self._index = 0
        self._left_s = 0.0
        self._seen_s = 0.0
        self._hover = np.zeros((1, 12))

    def curve(
        self, now_s: float, position: NDArray[np.float64], velocity: NDArray[np.float64], yaw: float
    ) -> NDArray[np.float64]:
        """The row to hold now (1, 12), or one that asks for a hover where the vehicle is."""
        self._go_on(now_s)
        if self._rows is not None and self._collision.due(now_s, self._seq):
            self.acted["brake"] += self._collision.brake
            self._drop()
        if self._rows is not None:
            return self._rows[self._index : self._index + 1]
        self._hover[0, 0], self._hover[0, 1:4], self._hover[0, 10] = now_s, position, yaw
        return self._hover

    def tracked(self, now_s: float) -> NDArray[np.float64]:
        """The row that is held, and before it the one that was held before."""
        shown = np.zeros((2, WAYPOINT_FIELDS))
        rows = self._hover if self._rows is None else self._rows
        for place, index in enumerate((max(self._index - 1, 0), self._index)):
            shown[place, 0] = self._duration_s(index)
            shown[place, 1:] = rows[index, 1:10]
        return shown

    def skip_waypoint(self, now_s: float) -> bool:
        """Drop the row that is held and hold the next; False, and a hover, after the last."""
        self.take_back()
        if self._rows is None:
            return False
        if self._index + 1 == len(self._rows):
            self._drop()
            return False
        self._index += 1
        self._left_s = self._duration_s(self._index)
        return True

    def _take(self, trajectory_seq: int, points: NDArray[np.float64]) -> None:
        self.curves += 1
        self._seq, self._index = trajectory_seq, 0
        self._rows = points if len(points) else None
        self._left_s = self._duration_s(0)

    def _go_on(self, now_s: float) -> None:
        """Take off what has passed of the row's duration, and go on to the rows after it."""
        self._left_s -= (now_s - self._seen_s) * self._report[PACE]
        self._seen_s = now_s
        while self._rows is not None and self._left_s <= 0.0:
            self._index += 1
            if self._index == len(self._rows):
                self._drop()
            else:
                self._left_s += self._duration_s(self._index)

    def _drop(self) -> None:
        self.curves += 1
        self._rows, self._index = None, 0

    def _duration_s(self, index: int) -> float:
        """How long a row lasts: to the time of the next; the last one, until the next look."""
        rows = self._rows
        if rows is None or index + 1 >= len(rows):
            return 0.0
        return float(rows[index + 1, 0] - rows[index, 0])
