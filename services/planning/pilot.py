"""When to plan, from which state, and when to give up."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np

from services.bus.arrays import NO_PLAN, POINT_FIELDS, Floats, Plan, Verdict
from services.models.mission import MissionSpec
from services.models.pilots import ALL_GUARDS, GuardName, Guards, Pace, find_pilot
from services.models.safety import BRAKE_BELOW_S, DECELERATION_M_S2
from services.planning.trajectory import Departure
from services.planning.voxels import CLOSE, NEAR

FAILURES_MAX = 40
"""Failed plans in a row after which the mission is given up: facts page, "replan"."""

ALTITUDE_M = (1.0, 10.0)
"""Between which paths lie: facts page, "planner"."""

MARGIN_M = 25.0
"""How far beyond start and goal the planner looks for a way round."""

Resort = Literal["none", "squeeze", "retreat"]
"""What is tried when no path is found."""

_NEXT_RESORT: Mapping[Resort, Resort] = MappingProxyType(
    {"none": "squeeze", "squeeze": "retreat", "retreat": "none"}
)

_SEQ_MAX = 2**32 - 1
GOAL_FAILURES_MAX = 6
"""Failed plans after which a goal is given up, if the mission has another: two rounds of resorts."""

_STRAYED_M = 2.5  # farther off the trajectory than any gust or lag: it is not being flown
_ARRIVED_M = 0.5
_RETREAT_M = 4.0
_TRAIL_STEP_M = 1.0
_STANDING_M_S = 0.3
_HOLD_STEP_S = 0.5


class Tactics(NamedTuple):
    """How a pilot decides: what :class:`services.models.pilots.Pilot`, its guards and its pace say of it."""

    leads_on: bool = True
    guards: Guards = ALL_GUARDS
    pace: Pace = Pace()


def tactics(spec: MissionSpec) -> Tactics:
    """The tactics of a mission's pilot."""
    return Tactics(find_pilot(spec.pilot).leads_on, spec.active_guards, spec.pace)


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """A request to plan: the state to start from and the goal to reach.

    ``trajectory_seq`` also counts the attempts, for the seed; ``limit`` is the level of voxels that
    are blocked.
    """

    departure: Departure
    goal: Floats
    trajectory_seq: int
    future_collision_seq: int
    limit: int
    retreat: bool

    def plan(self, points: Floats | None) -> Plan:
        """What answers the request: a trajectory, or None for no path."""
        made = NO_PLAN.points if points is None else points
        return Plan(self.trajectory_seq, self.future_collision_seq, made, failed=False)

    def box(self) -> tuple[Floats, Floats]:
        """Corners (3,) of the space to search."""
        low = np.minimum(self.departure.position, self.goal) - MARGIN_M
        high = np.maximum(self.departure.position, self.goal) + MARGIN_M
        low[2], high[2] = ALTITUDE_M
        return low, high


class Navigator:
    """Decides, verdict by verdict, whether to plan anew.

    Holds its newest trajectory and where the vehicle has been. A stage that was restarted in flight
    has neither, so it plans at once, and takes up the count of trajectories from the verdict. ``acted``
    counts what the guards did.
    """

    def __init__(self, goal: Floats, latency_s: float, tactics: Tactics) -> None:
        self._goal = goal
        self._latency_s = latency_s
        self._tactics = tactics
        self._standing_since_s: float | None = None
        self._opened = tactics.leads_on
        self.acted: Counter[GuardName] = Counter()
        self._points: Floats | None = None
        self._seq = 0
        self._answered = 0
        self._retreating = False
        self._failures = 0
        self._resort: Resort = "none"
        self._goal_failures = 0
        self._trail: deque[Floats] = deque(maxlen=64)

    def arrival(self, now_s: float, position: Floats) -> bool | None:
        """Whether the goal was reached (True) or is to be given up (False); None while it is flown to.

        It is given up when the trajectory has ended somewhere else, as near as one gets to a goal that
        is blocked, or when too many plans failed.
        """
        points = self._points
        if points is not None and now_s >= points[-1, 0] and not self._retreating:
            if np.linalg.norm(position - self._goal) <= _ARRIVED_M:
                return True
            if np.linalg.norm(position - points[-1, 1:4]) <= _ARRIVED_M:
                return False
        return False if self._goal_failures >= GOAL_FAILURES_MAX else None

    def head_for(self, goal: Floats) -> None:
        """Plan to another goal from now on."""
        if np.array_equal(goal, self._goal):
            return
        self._goal, self._points = goal, None
        self._goal_failures, self._resort, self._retreating = 0, "none", False

    def opening(self, now_s: float, position: Floats, yaw: float, verdict: Verdict) -> Plan | None:
        """What a pilot that does not lead on flies first, and once: it hovers and looks round.

        None if that is done, or if the verdict tells of a trajectory: then only this stage is new.
        """
        if self._opened or verdict.trajectory_seq:
            self._opened = True
            return None
        self._opened = True
        pace = self._tactics.pace
        self._points = looking_round(now_s, position, yaw, pace.take_off_s, pace.look_round_s)
        return Plan(0, verdict.future_collision_seq, self._points, failed=False)

    def consider(
        self, now_s: float, position: Floats, velocity: Floats, yaw: float, verdict: Verdict
    ) -> PlanRequest | None:
        """The plan to make at virtual time ``now_s``, or None if the present trajectory will do.

        ``position`` and ``velocity`` (3,) in the world frame; the trajectory will be flown from
        ``latency_s`` later on.
        """
        self._remember(position)
        if not self._must_plan(now_s, position, verdict):
            self._standing_since_s = None
            return None
        if not (self._tactics.leads_on or self._waited(now_s, velocity)):
            return None
        self._standing_since_s = None
        self._seq = min((self._seq or verdict.trajectory_seq) + 1, _SEQ_MAX)
        refuge = self._refuge(position) if self._resort == "retreat" else None
        return PlanRequest(
            departure=self._departure(now_s, position, velocity, yaw, verdict),
            goal=self._goal if refuge is None else refuge,
            trajectory_seq=self._seq,
            future_collision_seq=verdict.future_collision_seq,
            limit=NEAR if self._resort == "none" else CLOSE,
            retreat=refuge is not None,
        )

    def answer(self, request: PlanRequest, points: Floats | None) -> Plan:
        """The plan to publish once the planner has answered ``request`` with a trajectory or None.

        A plan in flight that failed is tried again from a standstill. What failed from there is tried
        with less clearance, then after a retreat. Only a way to the goal ends the row of failures.
        """
        if points is None:
            self._failures += 1
            self._goal_failures += 1
            if not request.departure.velocity.any():
                self._resort = self._next_resort()
        else:
            self._failures = self._failures if request.retreat else 0
            self._resort = "none"
        self._points = points
        self._retreating = request.retreat
        self._answered = request.future_collision_seq
        return request.plan(points)._replace(failed=self._failures > FAILURES_MAX)

    def _next_resort(self) -> Resort:
        following = _NEXT_RESORT[self._resort]
        if following != "squeeze":
            return following
        if "squeeze" not in self._tactics.guards:
            return _NEXT_RESORT[following]
        self.acted["squeeze"] += 1
        return following

    def _must_plan(self, now_s: float, position: Floats, verdict: Verdict) -> bool:
        points = self._points
        if points is None or verdict.future_collision_seq > self._answered:
            return True
        if self._by(
            "recheck", verdict.trajectory_seq == self._seq and math.isfinite(verdict.time_to_collision_s)
        ):
            return True
        if now_s >= points[-1, 0]:
            return self._retreating or bool(np.linalg.norm(position - self._goal) > _ARRIVED_M)
        return self._by("strayed", self._strayed(now_s, position))

    def _by(self, guard: GuardName, needed: bool) -> bool:
        """Whether a guard that is switched on has found a plan ``needed``."""
        acts = needed and guard in self._tactics.guards
        self.acted[guard] += acts
        return acts

    def _waited(self, now_s: float, velocity: Floats) -> bool:
        """Whether the vehicle has stood for as long as the pilot waits before it plans."""
        if np.linalg.norm(velocity) > _STANDING_M_S:
            self._standing_since_s = None
            return False
        if self._standing_since_s is None:
            self._standing_since_s = now_s
        return now_s - self._standing_since_s >= self._tactics.pace.plan_wait_s

    def _strayed(self, now_s: float, position: Floats) -> bool:
        """Whether the vehicle is not where the present trajectory wants it."""
        if self._points is None:
            return True
        row = self._points[min(int(np.searchsorted(self._points[:, 0], now_s)), len(self._points) - 1)]
        # A trajectory that is not finite is one that nobody flies.
        return not np.linalg.norm(position - row[1:4]) <= _STRAYED_M

    def _departure(
        self, now_s: float, position: Floats, velocity: Floats, yaw: float, verdict: Verdict
    ) -> Departure:
        """The state ahead from which to plan: on the trajectory if it is flown on, else at a stop."""
        ready_s = now_s + self._latency_s
        collision_s = verdict.checked_s + verdict.time_to_collision_s
        points = self._points
        in_time = self._tactics.leads_on and collision_s - now_s >= BRAKE_BELOW_S
        if points is not None and in_time and ready_s < points[-1, 0] and not self._strayed(now_s, position):
            row = points[np.searchsorted(points[:, 0], ready_s)]
            return Departure(row[0], row[1:4], row[4:7], row[7:10], row[10])
        stop_s = float(np.linalg.norm(velocity)) / DECELERATION_M_S2
        stop = position + 0.5 * stop_s * velocity
        return Departure(max(ready_s, now_s + stop_s), stop, np.zeros(3), np.zeros(3), yaw)

    def _remember(self, position: Floats) -> None:
        if self._retreating:
            return
        if not self._trail or np.linalg.norm(position - self._trail[-1]) > _TRAIL_STEP_M:
            self._trail.append(position.copy())

    def _refuge(self, position: Floats) -> Floats | None:
        """The last place on the trail that is some way back; the trail ends there from now on."""
        while self._trail and np.linalg.norm(position - self._trail[-1]) < _RETREAT_M:
            self._trail.pop()
        return self._trail[-1] if self._trail else None


def looking_round(now_s: float, position: Floats, yaw: float, hover_s: float, turn_s: float) -> Floats:
    """Trajectory (n, 12) that hovers at ``position`` (3,) for a time, then turns once on the spot."""
    steps = max(math.ceil(turn_s / _HOLD_STEP_S), 1)
    rows = np.zeros((steps + 2, POINT_FIELDS))
    rows[1:, 0] = hover_s + np.linspace(0.0, turn_s, steps + 1)
    rows[:, 0] += now_s
    rows[:, 1:4] = position
    rows[0, 10] = yaw
    turned = yaw + np.linspace(0.0, math.tau, steps + 1)
    rows[1:, 10] = (turned + math.pi) % math.tau - math.pi
    rows[1:, 11] = 1.0
    return rows
