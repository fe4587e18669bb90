"""One flight: the vehicle under the commands that reach it, its meter and its referee."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from services.bus.topics import TICK_NS
from services.models.mission import MissionSpec
from services.models.outcome import MissionResult, QoF
from sim.mission.area import corners
from sim.mission.objective import objective
from sim.mission.qof import FlightMeter
from sim.mission.referee import judge
from sim.mission.true_path import PathWriter
from sim.sensors.imu import ImuSamples, InertialUnit
from sim.sensors.odometry import Drift
from sim.vehicle.airframe import Airframe, airframe
from sim.vehicle.motor_fault import MotorFault
from sim.vehicle.vehicle import STEP_S, Floats, Vehicle
from sim.vehicle.wind import Air
from sim.world import make_world

if TYPE_CHECKING:
    from sim.autopilot.px4 import Px4Autopilot

STEP_NS = round(STEP_S * 1e9)
HOVER = np.zeros(4)


class SimulatedFlight:
    """A vehicle that holds its last command: it hovers before the first, and coasts when none follows.

    Its true state goes to the file ``true_path``, if there is one (:mod:`sim.mission.true_path`).
    """

    def __init__(self, spec: MissionSpec, true_path: Path | None = None) -> None:
        self._true_path = PathWriter(true_path) if true_path is not None else None
        frame = airframe(spec.airframe)
        self.world = make_world(spec.world, spec.seed)
        self.motor_fault = None
        if spec.fault is not None and spec.fault.level == "actuator":
            self.motor_fault = MotorFault(spec.fault, spec.seed, frame.max_thrust_n, STEP_S)
        self._controller = _controller(spec, frame)
        air = Air(spec.wind, spec.seed, STEP_S)
        self.vehicle = Vehicle(self.world, frame, air, self.motor_fault, self._controller)
        self.drift = Drift(spec.odometry, spec.seed, TICK_NS / 1e9)
        self._imu = InertialUnit(spec.imu, spec.seed)
        self.felt: ImuSamples | None = None
        """The IMU's samples of the last tick; None before the first."""
        self.area = None if spec.mission == "navigation" else corners(spec.area, self.world)
        self._objective = objective(spec, self.world, self.area)
        self._time_limit_s = spec.limits.mission_time_s
        self._meter = FlightMeter(self.world, frame, spec.energy)
        self._command: Floats = HOVER

    def advance(self, tick_ns: int, commands: Sequence[tuple[int, Floats]]) -> None:
        """Fly the tick that begins at ``tick_ns``.

        Each command (ready_ns, (4,)) holds from the next physics step on.
        """
        tracks = []
        steps_left = TICK_NS // STEP_NS
        for ready_ns, command in commands:
            passed = TICK_NS // STEP_NS - steps_left
            steps = min(max(-((tick_ns - ready_ns) // STEP_NS) - passed, 0), steps_left)
            tracks += self._fly(steps)
            steps_left -= steps
            self._command = command
        tracks += self._fly(steps_left)
        self.felt = self._measured(tracks)
        self.drift.advance()
        self._objective.observe(self.vehicle)

    def _fly(self, steps: int) -> list[Floats]:
        """The track of so many steps; none of none, nor after a contact."""
        return [self.vehicle.advance(self._command, steps)] if steps and not self.vehicle.contact else []

    def _measured(self, tracks: Sequence[Floats]) -> ImuSamples | None:
        """Take up the stretches of a tick; what the IMU measured on them."""
        if not tracks:
            return None
        # The first row of each is the last one of that before.
        track = np.concatenate([tracks[0], *(one[1:] for one in tracks[1:])])
        near = self._meter.add(track)
        if self._true_path is not None:
            self._true_path.append(track, near)
        return self._imu.sample(track)

    def judge(self, *, no_path: bool) -> MissionResult | None:
        """The mission's result so far."""
        vehicle = self.vehicle
        return judge(
            self._time_limit_s,
            time_s=vehicle.time_s,
            accomplished=self._objective.accomplished,
            contact=vehicle.contact,
            no_path=no_path,
        )

    def close(self) -> None:
        """End the autopilot, if it is a program."""
        if self._controller is not None:
            self._controller.close()

    def qof(self, *, success: bool, replans: int) -> QoF:
        """Quality of the flight so far."""
        qof = self._meter.qof(success=success, replans=replans)
        return qof.model_copy(update={"coverage": self._objective.coverage})


def _controller(spec: MissionSpec, frame: Airframe) -> Px4Autopilot | None:
    """The program in the flight controller's place, if the mission has one."""
    program = spec.stack.autopilot if spec.stack is not None else None
    if program is None:
        return None
    from sim.autopilot.px4 import Px4Autopilot  # noqa: PLC0415 - most missions have none

    return Px4Autopilot(program, frame, STEP_S, spec.imu, spec.seed)
