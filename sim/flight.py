"""One flight: the vehicle under the commands that reach it, its meter and its referee."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from services.bus.outcome import MissionResult, QoF
from services.bus.topics import TICK_NS
from sim.airframe import Airframe
from sim.qof import FlightMeter
from sim.referee import judge
from sim.vehicle import STEP_S, Floats, Vehicle
from sim.world import World

STEP_NS = round(STEP_S * 1e9)
HOVER = np.zeros(4)


class Flight:
    """A vehicle that holds its last command: it hovers before the first, and coasts when none follows."""

    def __init__(self, world: World, airframe: Airframe, time_limit_s: float) -> None:
        self.vehicle = Vehicle(world, airframe)
        self._world = world
        self._time_limit_s = time_limit_s
        self._meter = FlightMeter(world, airframe)
        self._command: Floats = HOVER

    def advance(self, tick_ns: int, commands: Sequence[tuple[int, Floats]]) -> None:
        """Fly the tick that begins at ``tick_ns``.

        Each command (ready_ns, (4,)) holds from the next physics step on.
        """
        steps_left = TICK_NS // STEP_NS
        for ready_ns, command in commands:
            passed = TICK_NS // STEP_NS - steps_left
            steps = min(max(-((tick_ns - ready_ns) // STEP_NS) - passed, 0), steps_left)
            self._fly(steps)
            steps_left -= steps
            self._command = command
        self._fly(steps_left)

    def _fly(self, steps: int) -> None:
        if steps and not self.vehicle.contact:
            self._meter.add(self.vehicle.advance(self._command, steps))

    def judge(self, *, no_path: bool) -> MissionResult | None:
        """The mission's result so far."""
        vehicle = self.vehicle
        return judge(
            self._world.goal,
            self._time_limit_s,
            time_s=vehicle.time_s,
            position=vehicle.position,
            velocity=vehicle.velocity,
            contact=vehicle.contact,
            no_path=no_path,
        )

    def qof(self, *, success: bool, replans: int) -> QoF:
        """Quality of the flight so far."""
        return self._meter.qof(success=success, replans=replans)
