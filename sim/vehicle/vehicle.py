"""The vehicle: rigid body, rotors and flight controller in a world, stepped by MuJoCo.

World frame x east, y north, z up; body frame x forward, y left, z up; quaternions (w, x, y, z).
"""

from __future__ import annotations

from math import atan2, cos, sin
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.vehicle.airframe import GRAVITY_M_S2, ROTORS, Airframe
from sim.vehicle.autopilot import Autopilot
from sim.vehicle.motor_fault import MotorFault
from sim.vehicle.wind import Air
from sim.world import World

Floats = NDArray[np.float64]

STEP_S = 0.004
"""Physics step and period of the flight controller: 250 Hz."""

TRACK_WIDTH = 14

_MOVING = ".85 .4 .1 1"


class ExternalController(Protocol):
    """A flight controller in a process of its own, called at each physics step; as :class:`Autopilot`."""

    def settle(self, pose: Floats, twist: Floats) -> None:
        """Make it ready while the vehicle is held where it is."""

    def command(self, velocity_command: Floats) -> None:
        """Take up (vx, vy, vz, yaw rate) in the world frame, m/s and rad/s."""

    def update(self, pose: Floats, twist: Floats, thrust: Floats) -> None:
        """Write the thrust of each rotor for one period."""


class PhysicsDivergedError(RuntimeError):
    """The state of the vehicle is no longer finite: a bug of the simulator, whatever the command."""


def mjcf(world: World, airframe: Airframe) -> str:
    """The MuJoCo model of ``airframe`` in ``world``, as MJCF text.

    Bodies: the fixed world (ground and obstacles), obstacles that move, and ``hull``, a free
    body. Only the hull is tested for contact, against everything else. Each rotor is a thrust along
    its axis with the reaction torque as a fixed part of it, behind a first-order lag. Euler's method is
    enough: at 4 ms its error is far below what the flight controller corrects.
    """
    inertia = " ".join(map(repr, airframe.inertia_kg_m2))
    boxes = "\n".join(map(_box, world.fixed))
    movers = "\n".join(
        f'<body name="mover{i}" mocap="true">{_box(box - np.tile(centre, 2), _MOVING)}</body>'
        for i, (box, centre) in enumerate(zip(world.moved(0.0), _centres(world, 0.0), strict=True))
    )
    lever, torque = airframe.lever_m, airframe.torque_per_thrust_m
    sites = "\n".join(
        f'<site name="rotor{i}" pos="{x * lever!r} {y * lever!r} 0"/>' for i, (x, y, _) in enumerate(ROTORS)
    )
    rotors = "\n".join(
        f'<general site="rotor{i}" dyntype="filterexact" dynprm="{airframe.rotor_time_constant_s!r}"'
        f' gear="0 0 1 0 0 {spin * torque!r}" ctrlrange="0 {airframe.max_thrust_n!r}"/>'
        for i, (_, _, spin) in enumerate(ROTORS)
    )
    return f"""
<mujoco model="{airframe.name} in {world.name}">
  <compiler autolimits="true"/>
  <option timestep="{STEP_S}" integrator="Euler" gravity="0 0 {-GRAVITY_M_S2}">
    <flag autoreset="disable"/>
  </option>
  <visual><global offwidth="1280" offheight="960"/></visual>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 1" contype="0" conaffinity="1" rgba=".45 .55 .4 1"/>
{boxes}
{movers}
    <body name="hull">
      <freejoint/>
      <inertial pos="0 0 0" mass="{airframe.mass_kg!r}" diaginertia="{inertia}"/>
      <geom type="cylinder" size="{airframe.hull_radius_m!r} {airframe.hull_height_m / 2!r}"
            contype="1" conaffinity="0" group="3"/>
      <camera name="front" xyaxes="0 -1 0 0 0 1"/>
{sites}
    </body>
  </worldbody>
  <actuator>
{rotors}
  </actuator>
</mujoco>
"""


def _box(corners: Floats, colour: str = ".6 .45 .35 1") -> str:
    centre = " ".join(repr(float(value)) for value in (corners[:3] + corners[3:]) / 2)
    half = " ".join(repr(float(value)) for value in (corners[3:] - corners[:3]) / 2)
    return f'<geom type="box" pos="{centre}" size="{half}" contype="0" conaffinity="1" rgba="{colour}"/>'


def _centres(world: World, time_s: float) -> Floats:
    """Where the middles of the moving obstacles are at a virtual time, (m, 3)."""
    boxes = world.moved(time_s)
    return (boxes[:, :3] + boxes[:, 3:]) / 2


class Vehicle:
    """A vehicle that starts in hover at the world's start, nose towards the goal.

    ``model`` and ``data`` are MuJoCo's and ``hull`` is the body's number there, for sensors to look
    into. ``steps`` counts the physics steps taken; ``contact_step`` is the one after which the hull
    first touched an obstacle or the ground, None as long as it has not. Without ``air`` there is no wind.
    """

    def __init__(
        self,
        world: World,
        airframe: Airframe,
        air: Air | None = None,
        motor_fault: MotorFault | None = None,
        controller: ExternalController | None = None,
    ) -> None:
        self.model = mujoco.MjModel.from_xml_string(mjcf(world, airframe))
        # The translational axes of a free joint are the world's: heave drag acts along the vertical, from
        # which the vehicle tilts by 30 degrees at most.
        self._drag = np.array([airframe.level_drag_n_s_m] * 2 + [airframe.heave_drag_n_s_m])
        self.model.dof_damping[:3] = self._drag
        self.data = mujoco.MjData(self.model)
        self.hull: int = self.model.body("hull").id
        self.steps = 0
        self.contact_step: int | None = None
        self._pose: Floats = self.data.qpos
        self._twist: Floats = self.data.qvel
        self._thrust: Floats = self.data.ctrl
        self._push: Floats = self.data.xfrc_applied[self.hull, :3]
        self._air = air
        self._motor_fault = motor_fault
        self._world = world
        self._moving = bool(len(world.moving))

        towards = world.goal - world.start
        yaw = atan2(towards[1], towards[0])
        self._pose[:3] = world.start
        self._pose[3:] = (cos(yaw / 2), 0.0, 0.0, sin(yaw / 2))
        self._thrust[:] = airframe.weight_n / len(ROTORS)
        self.data.act[:] = self._thrust
        self._move_obstacles()
        mujoco.mj_forward(self.model, self.data)
        self._autopilot: Autopilot | ExternalController = controller or Autopilot(airframe, STEP_S, yaw)
        if controller is not None:
            controller.settle(self._pose, self._twist)

    def advance(self, command: Floats, n_steps: int) -> Floats:
        """Flies ``n_steps`` physics steps under one velocity command.

        ``command`` is (vx, vy, vz, yaw rate), world frame, m/s and rad/s; see
        :meth:`Autopilot.command` for what is done with impossible ones. The return value is the
        flight's track (n_steps + 1, 14), first row the state before the first step: time in s, position
        in m and velocity in m/s (world frame), rates in rad/s (body frame), attitude (w, x, y, z).

        :raises PhysicsDivergedError: if the state is no longer finite.
        """
        model, data, autopilot = self.model, self.data, self._autopilot
        pose, twist, thrust, push = self._pose, self._twist, self._thrust, self._push
        track = np.empty((n_steps + 1, TRACK_WIDTH))
        track[:, 0] = np.arange(self.steps, self.steps + n_steps + 1) * STEP_S
        position, attitude = pose[:3], pose[3:]
        track[0, 1:4], track[0, 4:10], track[0, 10:] = position, twist, attitude
        # Drag is relative to the air: MuJoCo's damping has the vehicle's part, this is the wind's.
        wind = self._drag * self._air.velocity(self.steps, n_steps) if self._air is not None else None
        autopilot.command(command)
        for step, row in enumerate(track[1:]):
            if wind is not None:
                push[:] = wind[step]
            autopilot.update(pose, twist, thrust)
            if self._motor_fault is not None:
                self._motor_fault.strike(self.steps, thrust)
            self._move_obstacles()
            mujoco.mj_step(model, data)
            # Contacts are found where the step began.
            if data.ncon and self.contact_step is None:
                self.contact_step = self.steps
            self.steps += 1
            row[1:4], row[4:10], row[10:] = position, twist, attitude
        if self._moving:
            self._move_obstacles()
            mujoco.mj_kinematics(model, data)  # or sensors would see them where the last step began
        if not np.isfinite(track).all():
            message = f"state not finite after {self.steps} steps"
            raise PhysicsDivergedError(message)
        return track

    def _move_obstacles(self) -> None:
        """Put the moving obstacles where they are now; contacts and sensors meet them there."""
        if self._moving:
            self.data.mocap_pos[:] = _centres(self._world, self.time_s)

    @property
    def time_s(self) -> float:
        """The time that was flown so far, in seconds."""
        return self.steps * STEP_S

    @property
    def contact(self) -> bool:
        """Whether the hull has touched anything so far."""
        return self.contact_step is not None

    @property
    def position(self) -> Floats:
        """Centre of mass, world frame, m (3,)."""
        return self._pose[:3].copy()

    @property
    def quaternion(self) -> Floats:
        """Attitude, body to world, (w, x, y, z)."""
        return self._pose[3:].copy()

    @property
    def rotation(self) -> Floats:
        """Attitude as a matrix (3, 3), body to world."""
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, self._pose[3:])
        return matrix.reshape(3, 3)

    @property
    def yaw(self) -> float:
        """Heading, rad, 0 along x, counter-clockwise."""
        w, x, y, z = self._pose[3:]
        return atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))

    @property
    def velocity(self) -> Floats:
        """Velocity in the world frame, m/s (3,)."""
        return self._twist[:3].copy()

    @property
    def body_rates(self) -> Floats:
        """Angular velocity in the body frame, rad/s (3,)."""
        return self._twist[3:].copy()
