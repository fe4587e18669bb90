"""The objective of a mission, judged by the true position of the vehicle."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from services.models.mission import MissionSpec
from services.runtime.rng import generator
from sim.mission.area import cells
from sim.mission.referee import arrived
from sim.mission.view import CameraView, mark_overflown
from sim.vehicle.vehicle import Floats, Vehicle
from sim.world import World

TARGET_HEIGHT_M = 1.0
"""Of the target above the ground: somebody who sits or stands."""

TARGET_CLEARANCE_M = 1.0
"""Between the target and the nearest obstacle."""


class Objective(ABC):
    """Looks at the vehicle once a tick. ``coverage`` is the covered part of the area, if there is one."""

    accomplished = False
    coverage: float | None = None

    @abstractmethod
    def observe(self, vehicle: Vehicle) -> None:
        """Take in the vehicle's current position."""


def objective(spec: MissionSpec, world: World, area: Floats | None) -> Objective:
    """The objective of a mission; ``area`` (2, 3) as :func:`sim.mission.area.corners` gives it."""
    if area is None:
        return WaypointObjective(world.goal)
    if spec.mission == "delivery":
        return WaypointObjective(world.goal, world.start)
    view = CameraView(spec.camera, spec.mapping.range_m, world.obstacles)
    places, enough = cells(area, world.obstacles), spec.area.coverage
    if spec.mission == "scanning":
        return ScanObjective(places, enough, spec.area.swath_m)
    if spec.mission == "mapping":
        return SurveyObjective(places, enough, view)
    return SearchObjective(places, view, target(spec.seed, world, area))


def target(seed: int, world: World, area: Floats) -> Floats:
    """Where somebody waits to be found (3,): in the half of the area that is farther from the start."""
    free = cells(area, world.obstacles, TARGET_CLEARANCE_M)
    free = free if len(free) else cells(area, world.obstacles)
    away = np.linalg.norm(free - world.start, axis=1)
    far = free[away >= np.median(away)]
    place: Floats = far[generator(seed, "target").integers(len(far))].copy()
    place[2] = world.bounds[0, 2] + TARGET_HEIGHT_M
    return place


class WaypointObjective(Objective):
    """Places (3,) to arrive at, one after the other."""

    def __init__(self, *places: Floats) -> None:
        self._left = list(places)

    def observe(self, vehicle: Vehicle) -> None:
        """Tick off the next place when the vehicle has arrived there."""
        if self._left and arrived(self._left[0], vehicle.position, vehicle.velocity):
            self._left.pop(0)
        self.accomplished = not self._left


class _Covering(Objective):
    """Cells (n, 3) of which at least the part ``enough`` is to be covered."""

    def __init__(self, places: Floats, enough: float) -> None:
        self._places, self._enough = places, enough
        self._covered = np.zeros(len(places), dtype=np.bool_)

    def observe(self, vehicle: Vehicle) -> None:
        """Mark the cells that are covered now and add them up."""
        self._mark(vehicle)
        self.coverage = float(self._covered.mean())
        self.accomplished = self.coverage >= self._enough

    @abstractmethod
    def _mark(self, vehicle: Vehicle) -> None:
        """Set ``_covered`` where the vehicle covers the cells."""


class ScanObjective(_Covering):
    """The area is overflown: each cell counts that comes within half a swath, level."""

    def __init__(self, places: Floats, enough: float, swath_m: float) -> None:
        super().__init__(places, enough)
        self._half_swath_m = swath_m / 2

    def _mark(self, vehicle: Vehicle) -> None:
        mark_overflown(self._places, self._covered, vehicle.position, self._half_swath_m)


class SurveyObjective(_Covering):
    """The area is seen: each cell counts that the camera had in view within the mapping range."""

    def __init__(self, places: Floats, enough: float, view: CameraView) -> None:
        super().__init__(places, enough)
        self._view = view

    def _mark(self, vehicle: Vehicle) -> None:
        self._view.mark(vehicle, self._places, self._covered)


class SearchObjective(SurveyObjective):
    """The target (3,) comes into view; how much of the area was seen is reported as well."""

    def __init__(self, places: Floats, view: CameraView, where: Floats) -> None:
        super().__init__(places, 1.0, view)
        self._target, self._found = where[np.newaxis], np.zeros(1, dtype=np.bool_)

    def observe(self, vehicle: Vehicle) -> None:
        """Look for the target, and mark the cells that are in view."""
        super().observe(vehicle)
        self._view.mark(vehicle, self._target, self._found)
        self.accomplished = bool(self._found[0])
