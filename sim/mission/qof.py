"""Quality of flight: what a flight took and how close it came to an obstacle."""

from __future__ import annotations

from math import hypot, inf, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.models.outcome import QoF
from sim.moving_boxes import boxes_at
from sim.vehicle.airframe import Airframe
from sim.vehicle.energy import PowerModel, momentum_w, power_model, regression_w
from sim.world import World

Floats = NDArray[np.float64]


class Totals(NamedTuple):
    """What a stretch of flight adds up to."""

    distance_m: float
    energy_j: float
    min_clearance_m: float


class Hull(NamedTuple):
    """The upright cylinder that touches things."""

    radius_m: float
    half_height_m: float


class FlightMeter:
    """Adds up a flight from its tracks, in the order in which :meth:`Vehicle.advance` returns them."""

    def __init__(self, world: World, airframe: Airframe, energy: str = "airframe") -> None:
        self._fixed, self._moving = np.ascontiguousarray(world.fixed), world.moving
        self._battery_j = airframe.battery_kj * 1000
        self._power = power_model(airframe, energy)
        self._hull = Hull(airframe.hull_radius_m, airframe.hull_height_m / 2)
        self._time_s = 0.0
        self._totals = Totals(0.0, 0.0, hull_clearance(world.start, world.obstacles, self._hull))

    def add(self, track: Floats) -> Floats:
        """Takes up the next stretch: ``track`` (n, 14) as :meth:`Vehicle.advance` returns it.

        Its first row is the last one of the stretch before. The clearance in m of each row comes back (n,).
        """
        near = clearances(track, self._fixed, self._moving, self._hull)
        self._totals = measure(self._totals, track, near, self._power)
        self._time_s = float(track[-1, 0])
        return near

    def qof(self, *, success: bool, replans: int) -> QoF:
        """Quality of the flight so far; the minimum clearance is infinite without obstacles."""
        energy_j = self._totals.energy_j
        return QoF(
            success=success,
            flight_time_s=self._time_s,
            distance_m=self._totals.distance_m,
            energy_kj=energy_j / 1000,
            state_of_charge=max(1.0 - energy_j / self._battery_j, 0.0),
            missions_per_charge=self._battery_j / energy_j if success else 0.0,
            replans=replans,
            min_clearance_m=self._totals.min_clearance_m,
        )


@njit(cache=True)
def hull_clearance(position: Floats, obstacles: Floats, hull: Hull) -> float:
    """Distance in m from the hull at ``position`` (3,) to the nearest of the boxes (n, 6); 0 when touching.

    The hull is taken as upright; beside a wall no tilt brings it nearer by more than 1 cm.
    """
    x, y, z = position[0], position[1], position[2]
    nearest = inf
    for i in range(len(obstacles)):
        dx = max(obstacles[i, 0] - x, x - obstacles[i, 3], 0.0)
        dy = max(obstacles[i, 1] - y, y - obstacles[i, 4], 0.0)
        dz = max(obstacles[i, 2] - z, z - obstacles[i, 5], 0.0)
        beside, above = max(hypot(dx, dy) - hull.radius_m, 0.0), max(dz - hull.half_height_m, 0.0)
        nearest = min(nearest, hypot(beside, above))
    return nearest


@njit(cache=True)
def clearances(track: Floats, fixed: Floats, moving: Floats, hull: Hull) -> Floats:
    """The hull's clearance in m at each row of a track (n, 14): (n,).

    From boxes that stand (k, 6) and obstacles that move (m, 11), where they are at the row's time.
    """
    found = np.empty(len(track))
    for k in range(len(track)):
        found[k] = hull_clearance(track[k, 1:4], fixed, hull)
        if len(moving):
            there = boxes_at(moving, track[k, 0])
            found[k] = min(found[k], hull_clearance(track[k, 1:4], there, hull))
    return found


@njit(cache=True)
def measure(before: Totals, track: Floats, near: Floats, power: PowerModel) -> Totals:
    """``before`` and a track (n, 14) with its clearances ``near`` (n,) together.

    Between two rows the vehicle moves with their mean velocity and the acceleration that leads from
    one velocity to the other.
    """
    distance, energy, clearance = before.distance_m, before.energy_j, before.min_clearance_m
    for k in range(len(track)):
        clearance = min(clearance, near[k])
        if k == 0:
            continue
        old, new = track[k - 1], track[k]
        duration = new[0] - old[0]
        step_x, step_y, step_z = new[1] - old[1], new[2] - old[2], new[3] - old[3]
        distance += sqrt(step_x * step_x + step_y * step_y + step_z * step_z)
        velocity = ((new[4] + old[4]) / 2, (new[5] + old[5]) / 2, (new[6] + old[6]) / 2)
        acceleration = (
            (new[4] - old[4]) / duration,
            (new[5] - old[5]) / duration,
            (new[6] - old[6]) / duration,
        )
        if power.by_regression:
            level, climb = hypot(velocity[0], velocity[1]), velocity[2]
            watts = regression_w(level, hypot(acceleration[0], acceleration[1]), climb, acceleration[2])
        else:
            watts = momentum_w(power, velocity, acceleration)
        energy += watts * duration
    return Totals(distance, energy, clearance)
