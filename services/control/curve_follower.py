"""Flying a trajectory along its curve, by the clock: as smooth as what its rows were taken from."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from services.control.follower import Follower, waypoints
from services.control.pid import state_at, stopping
from services.models.pilots import Guards, Pilot
from services.models.safety import DECELERATION_M_S2


class CurveFollower(Follower):
    """Flies the newest trajectory from its first row's time on; the present one is kept until then."""

    def __init__(self, pilot: Pilot, guards: Guards) -> None:
        super().__init__(pilot, guards)
        self._followed: NDArray[np.float64] | None = None
        self._followed_seq: int | None = None
        self._coming: tuple[int, NDArray[np.float64]] | None = None
        self._stop: NDArray[np.float64] | None = None
        self._dropped_s = math.nan
        self._flown: NDArray[np.float64] | None = None

    def skip_waypoint(self, now_s: float) -> bool:
        """Drop the waypoint that is flown to and take the next; False if none was dropped.

        In its place comes a row of the very curve that leads past it, so that rows stay as far apart as they
        were. Without a next one it stops. Of two neighbours only one is dropped: if that was no remedy, the
        row behind is wrong, and to drop one waypoint after the other would end in a stop. The last command's
        part in the controller's state is taken back: it is as if never made.
        """
        self.take_back()
        points = self._followed
        if points is None:
            return False
        ahead = int(np.searchsorted(points[:, 0], now_s, side="right"))
        if ahead >= len(points) - 1:
            self._followed = None
            return False
        if self._dropped_s in points[max(ahead - 1, 0) : ahead + 1, 0]:
            return False
        self._followed = past(points, ahead)
        self._dropped_s = float(self._followed[ahead, 0])
        return True

    def curve(
        self, now_s: float, position: NDArray[np.float64], velocity: NDArray[np.float64], yaw: float
    ) -> NDArray[np.float64]:
        """The trajectory to follow now: the newest, or a stop from the present state."""
        flown = self._taken_up(now_s, position, velocity, yaw)
        self.curves += flown is not self._flown
        self._flown = flown
        return flown

    def tracked(self, now_s: float) -> NDArray[np.float64]:
        """The :func:`waypoints` of the curve that is followed."""
        assert self._flown is not None  # noqa: S101 - asked for a command that was made
        return waypoints(self._flown, now_s)

    def _take(self, trajectory_seq: int, points: NDArray[np.float64]) -> None:
        self._coming = (trajectory_seq, points)

    def _taken_up(
        self, now_s: float, position: NDArray[np.float64], velocity: NDArray[np.float64], yaw: float
    ) -> NDArray[np.float64]:
        if self._coming is not None:
            seq, points = self._coming
            if len(points) == 0 or now_s >= points[0, 0]:
                self._coming = None
                self._followed_seq = seq
                self._followed = points if len(points) else None
                self._stop = None if len(points) else self._stop
        if self._followed is not None and self._collision.due(now_s, self._followed_seq):
            self.acted["brake"] += self._collision.brake
            self._followed = None
        if self._followed is not None:
            return self._followed
        if self._stop is None:
            self._stop = stopping(now_s, position, velocity, yaw, DECELERATION_M_S2)
            self.state[:] = 0.0
        return self._stop


def past(points: NDArray[np.float64], index: int) -> NDArray[np.float64]:
    """The trajectory ``points`` (n, 12) without its row ``index``, from whose neighbours comes another one.

    That has the time half-way between them and lies on the curve that the kernel flies from one to the
    other. The first row goes without replacement.
    """
    rest = np.delete(points, index, axis=0)
    if index == 0:
        return rest
    row = rest[index].copy()
    row[0] = 0.5 * (rest[index - 1, 0] + rest[index, 0])
    row[1:11] = state_at(rest, row[0])[:10]
    return np.insert(rest, index, row, axis=0)
