"""The goal logic of each mission type: which place comes next. Nothing here knows Zenoh."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from services.bus.arrays import FlightPlace, Floats
from services.bus.octomaps import known
from services.planning.frontier import frontier
from services.planning.pilot import ALTITUDE_M
from services.planning.sweep import lawn_mower
from services.planning.voxels import unpack

SIDELAP = 0.2
"""Part of a swath that the next lane covers again: a vehicle that swerves leaves no gap."""

_ROUND_M = 5.0  # how far beyond the area and the vehicle frontiers are looked for


class GoalContext(NamedTuple):
    """Where the vehicle is (3,), world frame, and whether that is the goal."""

    position: Floats
    reached: bool


class Goals(ABC):
    """One mission's goals. ``chooses`` says whether the next call of :meth:`next` runs its kernel."""

    chooses = False

    def look(self, position: Floats, payload: bytes, resolution_m: float) -> None:  # noqa: B027 - few do
        """Take in the map (data of an ``octomap_msgs/Octomap`` message), if the goals depend on it.

        :raises MalformedMap: if it is broken.
        """

    def decided(self) -> bytes:
        """All that the kernel has decided so far, bit by bit."""
        return b""

    @abstractmethod
    def next(self, standing: GoalContext) -> Floats | None:
        """The place (3,) to fly to now, world frame, or None if there is none.

        Called at the start and whenever the goal was reached or is to be given up. An itinerary insists
        on it, a sweep and an exploration go on to another. Changes nothing that a shallow copy shares.
        """


def goals(mission: str, place: FlightPlace, swath_m: float) -> Goals:
    """The goals of a mission type."""
    if mission == "scanning":
        return SweepGoals(place, swath_m)
    if mission in ("mapping", "search"):
        return ExplorationGoals(place)
    return WaypointGoals(place.goal, place.start) if mission == "delivery" else WaypointGoals(place.goal)


class WaypointGoals(Goals):
    """Places one after the other; the last one stays."""

    def __init__(self, *places: Floats) -> None:
        self._left = list(places)

    def next(self, standing: GoalContext) -> Floats | None:
        """The same place until it is reached."""
        if standing.reached and len(self._left) > 1:
            self._left = self._left[1:]
        return self._left[0]


class SweepGoals(Goals):
    """The lanes of a lawn-mower sweep, over and over; what cannot be reached is passed over.

    Begins at the lane's end that is nearest, so that a stage that was restarted in flight goes on
    about where it was.
    """

    chooses = True

    def __init__(self, place: FlightPlace, swath_m: float) -> None:
        self._area = place.lower, place.upper, place.start, (1.0 - SIDELAP) * swath_m
        self._ends = np.empty((0, 3))
        self._index = 0

    def decided(self) -> bytes:
        """The ends of all lanes, and which one is flown to."""
        return self._ends.tobytes() + self._index.to_bytes(8, "little")

    def next(self, standing: GoalContext) -> Floats | None:
        """The next end of a lane, whether or not the one before was reached."""
        if self.chooses:
            self._ends, self.chooses = lawn_mower(*self._area), False
            self._index = int(np.linalg.norm(self._ends - standing.position, axis=1).argmin())
        else:
            self._index = (self._index + 1) % len(self._ends)
        goal: Floats = self._ends[self._index]
        return goal


class ExplorationGoals(Goals):
    """Frontiers of the map within an area, until there are no more."""

    chooses = True

    def __init__(self, place: FlightPlace) -> None:
        self._lower, self._upper = place.lower, place.upper
        self._tried: list[Floats] = []

    def look(self, position: Floats, payload: bytes, resolution_m: float) -> None:
        """Unpack the map of the area and of the way there."""
        low = np.minimum(self._lower, position) - _ROUND_M
        high = np.maximum(self._upper, position) + _ROUND_M
        low[2], high[2] = ALTITUDE_M
        self._grid = unpack(payload, resolution_m, low, high)
        self._known = known(payload, resolution_m, low, high)

    def decided(self) -> bytes:
        """The frontiers that were chosen so far."""
        return np.array(self._tried).tobytes()

    def next(self, standing: GoalContext) -> Floats | None:
        """The best frontier; none is tried twice."""
        grid, tried = self._grid, np.array(self._tried).reshape(-1, 3)
        voxels = grid.levels, self._known, grid.origin, grid.resolution_m
        found = frontier(*voxels, self._lower, self._upper, standing.position, tried)
        if not len(found):
            return None
        self._tried = [*self._tried, found]
        return found


def warm_up_goals() -> None:
    """Compile the kernels before there is a flight."""
    here, corner = np.array([0.0, 0.0, 2.0]), np.array([4.0, 4.0, 2.0])
    for mission in ("scanning", "mapping"):
        aims = goals(mission, FlightPlace(here, here, here, corner), 2.0)
        aims.look(here, b"", 1.0)
        aims.next(GoalContext(here, reached=False))
