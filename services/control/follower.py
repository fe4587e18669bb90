"""What both ways to fly a trajectory share: which messages count, and the command for the present state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from services.control.collision_stop import CollisionStop
from services.control.pid import KERNEL_GUARDS, PACE, REPORT_SIZE, STATE_SIZE, pid, tuning
from services.models.pilots import GuardName, Guards, Pilot

WAYPOINT_FIELDS = 10
"""Numbers of a tracked waypoint: duration, x y z, vx vy vz, ax ay az."""


class Follower(ABC):
    """Keeps the newest trajectory and says which curve the kernel has to follow.

    All it knows is the newest trajectory and the newest verdict, so a stage that was restarted in
    flight is in the picture again once it has both; until then it stops and hovers. Times are virtual,
    in s. ``acted`` counts what the guards did, ``curves`` the curves that were taken up.
    """

    def __init__(self, pilot: Pilot, guards: Guards) -> None:
        self._tuning = tuning(pilot, guards)
        self._collision = CollisionStop(brake="brake" in guards)
        self._ordered = "order" in guards
        self._newest_seq = 0
        self.state = np.zeros(STATE_SIZE)
        self._before = np.zeros(STATE_SIZE)
        self._report = np.zeros(REPORT_SIZE)
        self.acted: Counter[GuardName] = Counter()
        self.curves = 0

    def take_trajectory(
        self, trajectory_seq: int, future_collision_seq: int, points: NDArray[np.float64]
    ) -> bool:
        """Take in a trajectory (n, 12), or an empty one for: no path, stop. False if it is refused.

        One that was planned before the newest collision was found is refused, and one that is older than
        the trajectory of the newest verdict (guard ``order``) or than the newest that came.
        """
        if future_collision_seq < self._collision.collisions:
            return False
        if trajectory_seq < ((self._collision.checked or 0) if self._ordered else self._newest_seq):
            self.acted["order"] += self._ordered
            return False
        self._newest_seq = trajectory_seq
        self._collision.take_trajectory(future_collision_seq)
        self._take(trajectory_seq, points)
        return True

    def take_verdict(
        self, checked_s: float, trajectory_seq: int, future_collision_seq: int, time_to_collision_s: float
    ) -> None:
        """Take in a verdict: ``time_to_collision_s`` from ``checked_s`` on, ``inf`` for no collision."""
        self._collision.take_verdict(checked_s, trajectory_seq, future_collision_seq, time_to_collision_s)

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
        command: NDArray[np.float64] = pid(
            curve, now_s, position, velocity, yaw, period_s, self.state, self._tuning, self._report
        )
        for guard, times in zip(KERNEL_GUARDS, self._report[PACE + 1 :].tolist(), strict=True):
            if times:
                self.acted[guard] += int(times)
        return command

    def take_back(self) -> None:
        """Take the last command's part in the controller's state back: it is as if never made."""
        self.state[:] = self._before

    @abstractmethod
    def curve(
        self, now_s: float, position: NDArray[np.float64], velocity: NDArray[np.float64], yaw: float
    ) -> NDArray[np.float64]:
        """The trajectory that the kernel has to follow now."""

    @abstractmethod
    def tracked(self, now_s: float) -> NDArray[np.float64]:
        """The waypoint that is flown towards and the row behind it, as :func:`waypoints` has them."""

    @abstractmethod
    def skip_waypoint(self, now_s: float) -> bool:
        """Drop the waypoint that is flown to and take the next; False if none was dropped.

        The last command's part in the controller's state is taken back: it is as if never made.
        """

    @abstractmethod
    def _take(self, trajectory_seq: int, points: NDArray[np.float64]) -> None:
        """Take in a trajectory that was not refused."""


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
