"""The simulator on the bus: owns the clock, publishes sensors, flies the commands."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np

from services.bus import frames
from services.bus.horizon import NEVER_NS
from services.bus.messages import Mission, TwistStamped, header
from services.bus.ports import Input
from services.bus.proxy_link import NodeLink
from services.bus.topics import TICK_NS
from services.models.mission import MissionSpec
from services.runtime.node import ClockOwner, Node
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats
from sim.flight import SimulatedFlight
from sim.sensors import telemetry
from sim.sensors.camera import DepthCamera
from sim.sensors.faults import SensorFault
from sim.vehicle.vehicle import Floats


def warm_up() -> None:
    """Compile the kernels before there is a flight."""
    for fields in ({"energy": "momentum"}, {"mission": "scanning"}, {"mission": "mapping"}):
        spec = MissionSpec.model_validate({"energy": "regression", **fields})
        flight = SimulatedFlight(spec)
        flight.advance(0, [(0, np.zeros(4))])
        DepthCamera(spec.camera, 0).render(flight.vehicle)


def main(setup: NodeSetup, proxy: NodeLink, stats: SharedStats) -> None:
    """Fly the mission tick by tick until the referee ends it."""
    spec = setup.spec
    flight, camera = SimulatedFlight(spec, setup.true_path), DepthCamera(spec.camera, spec.seed)
    failing = SensorFault(spec.fault, spec.seed) if spec.fault and spec.fault.level == "sensor" else None
    with closing(flight), ClockOwner(setup, proxy, stats) as node:
        commands, plan = node.input("command"), node.input("trajectory")
        node.ready("perception")
        node.put("goal", telemetry.goal(header(0, frames.MAP), flight.world))
        if flight.area is not None:
            node.put("task", telemetry.task(header(0, frames.MAP), flight.world, flight.area))
        node.put("camera_info", telemetry.camera_info(header(0, frames.CAMERA_OPTICAL), camera))
        exposed_ns = -1
        while True:
            now_ns = node.now_ns
            pose = telemetry.odometry(header(now_ns, frames.ODOM), flight.vehicle, flight.drift)
            measure(node, failing, "odometry", pose)
            if (felt := flight.felt) is not None:
                measure(node, failing, "imu", telemetry.imu(header(now_ns, frames.BASE_LINK), felt))
            # A frame that a newer one will have replaced when perception is free is not exposed. Of what is
            # at the other end of a link nobody here knows.
            if not spec.link.is_ideal or now_ns + TICK_NS > node.busy_until("perception", exposed_ns):
                image = telemetry.depth_image(header(now_ns, frames.CAMERA_OPTICAL), camera, flight.vehicle)
                if measure(node, failing, "depth", image):
                    exposed_ns = now_ns
            else:
                node.skip()
            if report(node, flight, plan):
                node.promise(NEVER_NS, NEVER_NS)
                return
            node.promise(now_ns + TICK_NS, now_ns)
            node.advance(now_ns + TICK_NS)
            flight.advance(now_ns, [(one.ready_ns, velocity(commands.read(one))) for one in commands.new])
            if flight.motor_fault is not None:
                node.tell_injections(flight.motor_fault.records)


def measure(node: ClockOwner, failing: SensorFault | None, topic: str, message: Any) -> bool:
    """Publish what a sensor measured, or what it says instead; False if that is nothing."""
    if failing is None or failing.topic != topic:
        node.put(topic, message)
        return True
    published = failing.publish(message, node.now_ns)
    if published.record is not None:
        node.tell_injections([published.record])
    if published.message is None:
        return False
    node.put(topic, published.message)
    return True


def report(node: Node, flight: SimulatedFlight, plan: Input) -> bool:
    """Publish the mission's status, once a second and at its end; whether it has ended."""
    newest = plan.latest
    replans = max(newest.trajectory_seq - 1, 0) if newest is not None else 0
    result = flight.judge(no_path=newest is not None and bool(newest.failed))
    if result is not None or node.now_ns % 1_000_000_000 == 0:
        qof = flight.qof(success=result == "success", replans=int(replans))
        stamp = header(node.now_ns, frames.MAP)
        node.put(
            "mission",
            Mission(header=stamp, result=result or "flying", qof=qof.model_dump_json(exclude_none=True)),
        )
    return result is not None


def velocity(command: TwistStamped | None) -> Floats:
    """The velocity and yaw rate of a command; hover if it was malformed."""
    if command is None:
        return np.zeros(4)
    linear, angular = command.twist.linear, command.twist.angular
    return np.array([linear.x, linear.y, linear.z, angular.z])
