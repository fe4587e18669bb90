"""What control flies at the moment: a trajectory, a stop or a hover."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from services.control.pid import STATE_SIZE, pid, state_at, stopping
from services.models.safety import BRAKE_BELOW_S, DECELERATION_M_S2

WAYPOINT_FIELDS = 10
"""Numbers of a tracked waypoint: duration, x y z, vx vy vz, ax ay az."""


class Follower:
    """Keeps the newest trajectory and says which curve the kernel has to follow.

    All it knows is the newest trajectory and the newest verdict, so a stage that was restarted in
    flight is in the picture again once it has both; until then it stops and hovers. Times are virtual,
    in s.
    """

    def __init__(self) -> None:
        self._followed: NDArray[np.float64] | None = None
        self._followed_seq: int | None = None
        self._coming: tuple[int, NDArray[np.float64]] | None = None
        self._stop: NDArray[np.float64] | None = None
        self._collisions = 0
        self._collision_at_s = math.inf
        self._collision_on: int | None = None
        self.state = np.zeros(STATE_SIZE)
        self._before = np.zeros(STATE_SIZE)
        self._dropped_s = math.nan
        self._flown: NDArray[np.float64] | None = None
        self.curves = 0

    def take_trajectory(
        self, trajectory_seq: int, future_collision_seq: int, points: NDArray[np.float64]
    ) -> bool:
        """Take in a trajectory (n, 12), or an empty one for: no path, stop. False if it is refused.

        One that was planned before the newest collision was found is refused, and one that is older than
        the trajectory of the newest verdict. It is flown from its first row's time on; the present one is
        kept until then.
        """
        if future_collision_seq < self._collisions or trajectory_seq < (self._collision_on or 0):
            return False
        self._coming = (trajectory_seq, points)
        return True

    def take_verdict(
        self, checked_s: float, trajectory_seq: int, future_collision_seq: int, time_to_collision_s: float
    ) -> None:
        """Take in a verdict: ``time_to_collision_s`` from ``checked_s`` on, ``inf`` for no collision."""
        self._collisions = future_collision_seq
        self._collision_on = trajectory_seq
        self._collision_at_s = checked_s + time_to_collision_s

    def command(
        self,
        now_s: float,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        yaw: float,
        period_s: float,
    ) -> NDArray[np.float64]:
        """Flight command (vx, vy, vz, yaw rate) for the present state."""
        curve = self.curve(now_s, position, velocity, yaw)
        self._before[:] = self.state
        return pid(curve, now_s, position, velocity, yaw, period_s, self.state)

    def skip_waypoint(self, now_s: float) -> bool:
        """Drop the waypoint that is flown to and take the next; False if none was dropped.

        In its place comes a row of the very curve that leads past it, so that rows stay as far apart as they
        were. Without a next one it stops. Of two neighbours only one is dropped: if that was no remedy, the
        row behind is wrong, and to drop one waypoint after the other would end in a stop. The last command's
        part in the controller's state is taken back: it is as if never made.
        """
        self.state[:] = self._before
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
        """The trajectory to follow now: the newest, or a stop from the present state.

        ``curves`` counts those that were taken up.
        """
        flown = self._taken_up(now_s, position, velocity, yaw)
        self.curves += flown is not self._flown
        self._flown = flown
        return flown

    def tracked(self, now_s: float) -> NDArray[np.float64]:
        """The :func:`waypoints` of the curve that is followed."""
        assert self._flown is not None  # noqa: S101 - asked for a command that was made
        return waypoints(self._flown, now_s)

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
        near = self._collision_at_s - now_s < BRAKE_BELOW_S
        if near and self._collision_on == self._followed_seq:
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


def waypoints(curve: NDArray[np.float64], now_s: float) -> NDArray[np.float64]:
    """The waypoint of ``curve`` (n, 12) that is flown towards at ``now_s`` and the row behind it.

    (2, ``WAYPOINT_FIELDS``), the row behind first. A duration is the time in s that the curve grants from the
    row before; the curve's first row has that of the second. After the curve's end the last row is flown
    towards, before its beginning the first, which then also stands behind.
    """
    last = len(curve) - 1
    ahead = min(int(np.searchsorted(curve[:, 0], now_s, side="right")), last)
    rows = np.zeros((2, WAYPOINT_FIELDS))
    for row, index in zip(rows, (max(ahead - 1, 0), ahead), strict=True):
        begun = min(max(index, 1), last)
        row[0] = curve[begun, 0] - curve[max(begun - 1, 0), 0]
        row[1:] = curve[index, 1:10]
    return rows
