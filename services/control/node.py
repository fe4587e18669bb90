"""Control on the bus: one flight command for each odometry message."""

from __future__ import annotations

from functools import partial

import numpy as np

from services.bus import frames
from services.bus.arrays import POINT_FIELDS, Floats, VehicleState, plan, state, vector, verdict
from services.bus.detector_protocol import shown_command
from services.bus.messages import Twist, TwistStamped, header
from services.bus.proxy_link import NodeLink
from services.bus.topics import TICK_NS
from services.control.follower import Follower
from services.control.following import follower
from services.control.simple_controller import simple_command
from services.models.mission import MissionSpec
from services.runtime.node import Node
from services.runtime.realtime import join
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats

TICK_S = TICK_NS / 1e9


def warm_up() -> None:
    """Compile the kernels before there is a flight."""
    flown = follower(MissionSpec())
    state = np.zeros(3), np.ones(3), 0.0
    flown.command(0.0, *state, TICK_S)
    # What comes from the bus is read-only: to numba a type of its own.
    points = np.zeros((2, POINT_FIELDS))
    points.setflags(write=False)
    flown.take_trajectory(1, 0, points)
    flown.command(1.0, *state, TICK_S)


def main(setup: NodeSetup, proxy: NodeLink, stats: SharedStats) -> None:
    """Follow the newest trajectory, brake for what the collision check finds."""
    flown = follower(setup.spec)
    with join(setup, proxy, stats) as node:
        odometry, check, trajectory = (
            node.input("odometry", state),
            node.input("collision_check", verdict),
            node.input("trajectory", plan),
        )
        node.ready()
        for measured in node.spin(odometry):
            for found in map(check.read, check.new):
                if found is not None:
                    flown.take_verdict(*found)
            for made in map(trajectory.read, trajectory.new):
                if made is not None and not flown.take_trajectory(*made[:3]):
                    node.count("outdated")
            here = odometry.read(measured)
            if here is None:
                continue
            now_s = node.now_ns / 1e9
            _, command = node.recovery.sound(
                "command",
                partial(make, node, flown, now_s, here),
                partial(command_message, node),
                partial(shown, flown, now_s, here),
                flown.take_back if node.recovery.reexecutes else partial(flown.skip_waypoint, now_s),
                {
                    "stop": partial(np.zeros, 4),
                    "simple": partial(simple, flown, now_s, here, node.spec.motion.speed_m_s),
                },
                flown.take_back,
            )
            node.put("command", command)
            node.guards.take(flown.acted)


def make(node: Node, flown: Follower, now_s: float, here: VehicleState) -> Floats:
    """The command for the present state."""
    with node.kernel("pid"):
        return flown.command(now_s, here.position, here.velocity, here.yaw, TICK_S)


def simple(flown: Follower, now_s: float, here: VehicleState, speed_m_s: float) -> Floats:
    """The backup controller's command to the waypoint, in the place of one that is not to be trusted."""
    return simple_command(here.position, flown.tracked(now_s)[1, 1:4], speed_m_s)


def shown(flown: Follower, now_s: float, here: VehicleState, command: TwistStamped) -> Floats:
    """What a detector sees of a command: with it the waypoint that it flies to, and from where."""
    return shown_command(command, flown.curves, flown.tracked(now_s), here)


def command_message(node: Node, command: Floats) -> TwistStamped:
    """The message of a command (4,): velocity, world frame, and yaw rate."""
    twist = Twist(linear=vector(command[:3]), angular=vector(np.array([0.0, 0.0, command[3]])))
    return TwistStamped(header=header(node.now_ns, frames.MAP), twist=twist)
