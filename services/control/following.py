"""Which follower flies a mission: by its guards, along the curve or waypoint after waypoint."""

from __future__ import annotations

from services.control.curve_follower import CurveFollower
from services.control.follower import Follower
from services.control.waypoint_follower import WaypointFollower
from services.models.mission import MissionSpec
from services.models.pilots import find_pilot


def follower(spec: MissionSpec) -> Follower:
    """The follower of a mission, before its first trajectory."""
    kind = CurveFollower if "dense" in spec.active_guards else WaypointFollower
    return kind(find_pilot(spec.pilot), spec.active_guards)
