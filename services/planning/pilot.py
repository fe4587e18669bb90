"""When to plan, from which state, and when to give up."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.planning.trajectory import Departure

FAILURES_MAX = 40
"""Failed plans in a row after which the mission is given up: facts page, "replan"."""

BRAKE_BELOW_S = 2.0
"""A collision nearer than this is answered from a standstill: control will have braked for it."""

DECELERATION_M_S2 = 4.0
"""At which the vehicle is expected to stop."""

ALTITUDE_M = (1.0, 10.0)
"""Between which paths lie: facts page, "planner"."""

MARGIN_M = 25.0
"""How far beyond start and goal the planner looks for a way round."""

_STRAYED_M = 2.5  # farther off the trajectory than any gust or lag: it is not being flown
_ARRIVED_M = 0.5
_RETREAT_M = 4.0
_TRAIL_STEP_M = 1.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """What perception found on a trajectory; ``time_to_collision_s`` is ``inf`` for no collision."""

    checked_s: float
    trajectory_seq: int
    future_collision_seq: int
    time_to_collision_s: float


@dataclass(frozen=True, slots=True)
class Request:
    """A plan to be made. ``trajectory_seq`` also counts the attempts, for the seed."""

    departure: Departure
    goal: NDArray[np.float64]
    trajectory_seq: int
    future_collision_seq: int
    retreat: bool

    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Corners (3,) of the space to search."""
        low = np.minimum(self.departure.position, self.goal) - MARGIN_M
        high = np.maximum(self.departure.position, self.goal) + MARGIN_M
        low[2], high[2] = ALTITUDE_M
        return low, high


@dataclass(frozen=True, slots=True)
class Answer:
    """A trajectory (n, 12) for the bus; empty: no path was found. ``failed``: the mission is given up."""

    trajectory_seq: int
    future_collision_seq: int
    points: NDArray[np.float64]
    failed: bool


class Navigator:
    """Decides, verdict by verdict, whether to plan anew.

    Holds its newest trajectory and where the vehicle has been. A stage that was restarted in flight
    has neither, so it plans at once, and takes up the count of trajectories from the verdict.
    """

    def __init__(
        self, goal: NDArray[np.float64], latency_s: float, brake_below_s: float = BRAKE_BELOW_S
    ) -> None:
        self._goal = goal
        self._latency_s = latency_s
        self._brake_below_s = brake_below_s
        self._points: NDArray[np.float64] | None = None
        self._seq = 0
        self._answered = 0
        self._retreating = False
        self._failures = 0
        self._retreat_next = False
        self._trail: deque[NDArray[np.float64]] = deque(maxlen=64)

    def consider(
        self,
        now_s: float,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        yaw: float,
        verdict: Verdict,
    ) -> Request | None:
        """The plan to make at virtual time ``now_s``, or None if the present trajectory will do."""
        self._remember(position)
        if not self._must_plan(now_s, position, verdict):
            return None
        self._seq = max(self._seq, verdict.trajectory_seq) + 1
        refuge = self._refuge(position) if self._retreat_next else None
        return Request(
            departure=self._departure(now_s, position, velocity, yaw, verdict),
            goal=self._goal if refuge is None else refuge,
            trajectory_seq=self._seq,
            future_collision_seq=verdict.future_collision_seq,
            retreat=refuge is not None,
        )

    def answer(self, request: Request, points: NDArray[np.float64] | None) -> Answer:
        """What to publish once the planner has answered ``request`` with a trajectory or None.

        A plan in flight that failed is tried again from a standstill; one that failed from there is
        followed by a retreat. Only a way to the goal ends the row of failures.
        """
        if points is None:
            self._failures += 1
            self._retreat_next = not request.retreat and not request.departure.velocity.any()
        else:
            self._failures = self._failures if request.retreat else 0
            self._retreat_next = False
        self._points = points
        self._retreating = request.retreat
        self._answered = request.future_collision_seq
        return Answer(
            trajectory_seq=request.trajectory_seq,
            future_collision_seq=request.future_collision_seq,
            points=np.empty((0, 12)) if points is None else points,
            failed=self._failures > FAILURES_MAX,
        )

    def _must_plan(self, now_s: float, position: NDArray[np.float64], verdict: Verdict) -> bool:
        points = self._points
        if points is None or verdict.future_collision_seq > self._answered:
            return True
        if verdict.trajectory_seq == self._seq and math.isfinite(verdict.time_to_collision_s):
            return True
        if now_s >= points[-1, 0]:
            return self._retreating or bool(np.linalg.norm(position - self._goal) > _ARRIVED_M)
        return self._strayed(now_s, position)

    def _strayed(self, now_s: float, position: NDArray[np.float64]) -> bool:
        """Whether the vehicle is not where the present trajectory wants it."""
        if self._points is None:
            return True
        row = self._points[min(int(np.searchsorted(self._points[:, 0], now_s)), len(self._points) - 1)]
        return bool(np.linalg.norm(position - row[1:4]) > _STRAYED_M)

    def _departure(
        self,
        now_s: float,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        yaw: float,
        verdict: Verdict,
    ) -> Departure:
        """The state ahead from which to plan: on the trajectory if it is flown on, else at a stop."""
        ready_s = now_s + self._latency_s
        collision_s = verdict.checked_s + verdict.time_to_collision_s
        points = self._points
        in_time = collision_s - now_s >= self._brake_below_s
        if points is not None and in_time and ready_s < points[-1, 0] and not self._strayed(now_s, position):
            row = points[np.searchsorted(points[:, 0], ready_s)]
            return Departure(row[0], row[1:4], row[4:7], row[7:10], row[10])
        speed = float(np.linalg.norm(velocity))
        stop_s = speed / DECELERATION_M_S2
        return Departure(
            max(ready_s, now_s + stop_s), position + 0.5 * stop_s * velocity, np.zeros(3), np.zeros(3), yaw
        )

    def _remember(self, position: NDArray[np.float64]) -> None:
        if self._retreating:
            return
        if not self._trail or np.linalg.norm(position - self._trail[-1]) > _TRAIL_STEP_M:
            self._trail.append(position.copy())

    def _refuge(self, position: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """The last place on the trail that is some way back; the trail ends there from now on."""
        while self._trail and np.linalg.norm(position - self._trail[-1]) < _RETREAT_M:
            self._trail.pop()
        return self._trail[-1] if self._trail else None
