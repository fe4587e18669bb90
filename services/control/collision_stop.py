"""When to stop for a collision ahead."""

from __future__ import annotations

import math

from services.models.safety import BRAKE_BELOW_S


class CollisionStop:
    """Says whether it is time to stop, from the verdicts of the collision check.

    With the guard ``brake`` the newest verdict on the followed trajectory decides. Without it only one that
    counts a collision as new does, and its word holds until a trajectory comes that knows of it: so does the
    published system. Times are virtual, in s.
    """

    def __init__(self, *, brake: bool) -> None:
        self.brake = brake
        self.collisions = 0
        """Collisions counted so far: a trajectory that knows of fewer is outdated."""
        self.checked: int | None = None
        """The trajectory that the newest verdict is about."""
        self._collision_at_s = math.inf

    def take_verdict(
        self, checked_s: float, trajectory_seq: int, future_collision_seq: int, time_to_collision_s: float
    ) -> None:
        """Take in a verdict: ``time_to_collision_s`` from ``checked_s`` on, ``inf`` for no collision."""
        self.checked = trajectory_seq
        if self.brake or future_collision_seq > self.collisions:
            self.collisions = future_collision_seq
            self._collision_at_s = checked_s + time_to_collision_s

    def take_trajectory(self, future_collision_seq: int) -> None:
        """Take in that a trajectory has come that knows of so many collisions."""
        if not self.brake:
            self.collisions = future_collision_seq
            self._collision_at_s = math.inf

    def due(self, now_s: float, followed: int | None) -> bool:
        """Whether the vehicle on the trajectory of that number has to stop now."""
        near = self._collision_at_s - now_s < BRAKE_BELOW_S
        return near and (not self.brake or self.checked == followed)
