"""A flight controller in a process of its own, in lockstep: PX4's simulator protocol (docs/autopilots.md).

The program connects to our TCP port and is sent HIL_SENSOR at each physics step; the step is taken with the
HIL_ACTUATOR_CONTROLS that it answers. The commands of the control stage go to it as
SET_POSITION_TARGET_LOCAL_NED, by UDP, as those of any companion computer.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import time
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from services.models.equipment import Imu
from services.models.own_stack import OwnAutopilot
from services.system.lifeline import die_with_parent
from sim.autopilot import hil
from sim.autopilot.mavlink import (
    COMMAND_LONG,
    HEARTBEAT,
    HIL_ACTUATOR_CONTROLS,
    HIL_GPS,
    HIL_SENSOR,
    HIL_STATE_QUATERNION,
    SET_POSITION_TARGET_LOCAL_NED,
    Receiver,
    Sender,
)
from sim.vehicle.airframe import Airframe
from sim.vehicle.autopilot import accept_setpoint

Floats = NDArray[np.float64]

SIMULATOR_PORT, COMPANION_PORT, OFFBOARD_PORT = 4560, 14540, 14580
"""PX4's: where it looks for its simulator, tells a companion computer, and hears one; plus its instance."""

INSTANCES = 250
"""Ports that are tried for one that is free."""

PATIENCE_S = 20.0
"""Of wall time for one answer, and for the program to connect."""

_HOST = "127.0.0.1"
_GPS_STEPS, _SETPOINT_STEPS, _HEARTBEAT_STEPS = 25, 10, 250
_VELOCITY_AND_YAW_RATE = 0b0101_1100_0111
_LOCAL_NED = 1
_DO_SET_MODE, _ARM, _CUSTOM_MODE, _OFFBOARD = 176, 400, 1, 6
_ONBOARD_CONTROLLER, _NO_AUTOPILOT, _ACTIVE = 18, 8, 4


class AutopilotError(Exception):
    """The autopilot ended, or does not answer."""


class Px4Autopilot:
    """The flight controller of one vehicle; from its first step on it must be called at each physics step."""

    def __init__(
        self, program: OwnAutopilot, airframe: Airframe, period_s: float, imu: Imu, seed: int
    ) -> None:
        """Start the program and wait until it has connected.

        :raises AutopilotError: if it does not.
        """
        self._program, self._max_thrust_n, self._period_s = program, airframe.max_thrust_n, period_s
        self._sensors = hil.HilSensors(imu, seed)
        self._setpoint = np.zeros(4)
        self._velocity: Floats | None = None
        self._steps = 0
        self._to_simulated, self._to_offboard = Sender(1, 51), Sender(1, 191)
        self._receiver = Receiver()
        with ExitStack() as begun:
            door, radio, instance = open_ports()
            self._radio = begun.enter_context(radio)
            self._offboard = (_HOST, OFFBOARD_PORT + instance)
            with door:
                self._process = _start(program, instance)
                begun.callback(_stop, self._process)
                try:
                    self._link, _ = door.accept()
                except TimeoutError as error:
                    where = f"port {SIMULATOR_PORT + instance} within {PATIENCE_S:g} s"
                    message = f"autopilot: {' '.join(program.command)} did not connect to {where}"
                    raise AutopilotError(message) from error
            begun.enter_context(self._link)
            self._link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._link.settimeout(PATIENCE_S)
            self._owned = begun.pop_all()

    def settle(self, pose: Floats, twist: Floats) -> None:
        """Let the program boot, arm and take over the commands while the vehicle is held where it is.

        :raises AutopilotError: if it does not answer.
        """
        if self._program.boot_s:
            self._boot(pose, twist)
        idle = np.zeros(4)
        steps = round(self._program.settle_s / self._period_s)
        for step in range(steps):
            if step == steps // 2:
                self._ask(_DO_SET_MODE, _CUSTOM_MODE, _OFFBOARD)
                self._ask(_ARM, 1.0, 0.0)
            self.update(pose, twist, idle)

    def _boot(self, pose: Floats, twist: Floats) -> None:
        """Tell the program what there is to see as fast as in reality; what it answers yet is of no use."""
        for _ in range(round(self._program.boot_s / self._period_s)):
            self._tell(pose, twist)
            time.sleep(self._period_s)
        self._link.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while self._link.recv(1 << 16):
                pass
        self._link.settimeout(PATIENCE_S)

    def command(self, velocity_command: Floats) -> None:
        """Take up (vx, vy, vz, yaw rate), world frame, m/s and rad/s, as the built-in controller does."""
        accept_setpoint(velocity_command, self._setpoint)

    def update(self, pose: Floats, twist: Floats, thrust: Floats) -> None:
        """Write the thrust of each rotor, newtons (4,), for one period; poses as in :class:`Autopilot`.

        :raises AutopilotError: if the program does not answer.
        """
        self._tell(pose, twist)
        thrust[:] = self._max_thrust_n * hil.relative_thrusts(self._answer())

    def close(self) -> None:
        """End the program and free its ports."""
        self._owned.close()

    def _tell(self, pose: Floats, twist: Floats) -> None:
        """Send what the vehicle's sensors read now, the setpoint before it."""
        before = twist[:3] if self._velocity is None else self._velocity
        self._velocity = twist[:3].copy()
        force = hil.specific_force(before, self._velocity, self._period_s, pose[3:])
        state = hil.HilState(pose[:3], self._velocity, pose[3:], twist[3:], force)
        now_us = round(self._steps * self._period_s * 1e6)
        if self._steps % _HEARTBEAT_STEPS == 0:
            told = {"type": _ONBOARD_CONTROLLER, "autopilot": _NO_AUTOPILOT, "system_status": _ACTIVE}
            self._radio.sendto(self._to_offboard.frame(HEARTBEAT, mavlink_version=3, **told), self._offboard)
        if self._steps % _SETPOINT_STEPS == 0:
            self._radio.sendto(self._target(now_us), self._offboard)
        frames = [self._to_simulated.frame(HIL_STATE_QUATERNION, time_usec=now_us, **hil.truth(state))]
        if self._steps % _GPS_STEPS == 0:
            frames.append(self._to_simulated.frame(HIL_GPS, time_usec=now_us, **hil.gps(state)))
        frames.append(self._to_simulated.frame(HIL_SENSOR, time_usec=now_us, **self._sensors.sensor(state)))
        self._steps += 1
        try:
            self._link.sendall(b"".join(frames))
        except OSError as error:
            raise self._gone(error) from error

    def _target(self, now_us: int) -> bytes:
        vx, vy, vz = hil.to_ned(self._setpoint[:3])
        return self._to_offboard.frame(
            SET_POSITION_TARGET_LOCAL_NED,
            time_boot_ms=now_us // 1000,
            target_system=1,
            target_component=1,
            coordinate_frame=_LOCAL_NED,
            type_mask=_VELOCITY_AND_YAW_RATE,
            vx=vx,
            vy=vy,
            vz=vz,
            yaw_rate=-float(self._setpoint[3]),
        )

    def _ask(self, command: int, first: float, second: float) -> None:
        asked = self._to_offboard.frame(
            COMMAND_LONG, target_system=1, target_component=1, command=command, param1=first, param2=second
        )
        self._radio.sendto(asked, self._offboard)

    def _answer(self) -> tuple[float, ...]:
        """The controls of the next HIL_ACTUATOR_CONTROLS."""
        while True:
            try:
                data = self._link.recv(1 << 16)
            except OSError as error:
                raise self._gone(error) from error
            if not data:
                raise self._gone()
            answers = [
                values for kind, values in self._receiver.receive(data) if kind is HIL_ACTUATOR_CONTROLS
            ]
            if answers:
                return answers[-1]["controls"]

    def _gone(self, error: OSError | None = None) -> AutopilotError:
        what = f"did not answer within {PATIENCE_S:g} s"
        if not isinstance(error, TimeoutError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)  # it may be just ending
            status = self._process.returncode
            what = "closed its connection" if status is None else f"ended with status {status}"
        return AutopilotError(f"autopilot: {' '.join(self._program.command)} {what}")


def open_ports() -> tuple[socket.socket, socket.socket, int]:
    """Where the program will connect, from where it is commanded, and its instance: the first that is free.

    The second socket, kept as long as the program runs, keeps the instance from others.

    :raises AutopilotError: if there is none.
    """
    for instance in range(INSTANCES):
        radio = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        door = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        door.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        door.settimeout(PATIENCE_S)
        try:
            radio.bind((_HOST, COMPANION_PORT + instance))
            door.bind((_HOST, SIMULATOR_PORT + instance))
            door.listen(1)
        except OSError:
            radio.close()
            door.close()
        else:
            return door, radio, instance
    message = f"autopilot: the ports from {SIMULATOR_PORT} on are all taken"
    raise AutopilotError(message)


def _start(program: OwnAutopilot, instance: int) -> subprocess.Popen[bytes]:
    owner = os.getpid()
    command = [word.replace("{instance}", str(instance)) for word in program.command]
    try:
        return subprocess.Popen(  # noqa: S603 - what the specification names, by no shell
            command,
            cwd=program.folder,
            stdin=subprocess.DEVNULL,
            preexec_fn=lambda: die_with_parent(owner),  # noqa: PLW1509 - this process has one thread
        )
    except (OSError, subprocess.SubprocessError) as error:
        message = f"autopilot: {program.command[0]} cannot be run: {error}"
        raise AutopilotError(message) from error


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
