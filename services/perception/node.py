"""Perception on the bus: depth images to point cloud, occupancy map and collision verdict."""

from __future__ import annotations

from copy import copy
from functools import partial
from math import isfinite
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.bus import frames
from services.bus.arrays import (
    NO_PLAN,
    POINT_FIELDS,
    Plan,
    VehicleState,
    cloud_message,
    cloud_points,
    plan,
    state,
)
from services.bus.detector_protocol import shown_verdict
from services.bus.messages import header
from services.bus.proxy_link import NodeLink
from services.perception.collision import CollisionCounter, time_to_collision
from services.perception.messages import Pinhole, check_message, depth_array, map_message, pinhole
from services.perception.occupancy import OccupancyMap
from services.perception.point_cloud import in_world, point_cloud
from services.runtime.node import Node
from services.runtime.realtime import join
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats


def warm_up() -> None:
    """Compile the kernels before there is a flight."""
    occupancy = OccupancyMap(0.5, 10.0)
    depth = np.full((2, 2), 5.0, dtype=np.float32)
    # A frame's buffer comes from the bus and is read-only: to numba a type of its own.
    depth.setflags(write=False)
    here, ahead = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    scan = point_cloud(depth, 1.0, 1.0, 0.5, 0.5, occupancy.range_m)
    occupancy.insert(in_world(*scan, here, ahead), here)
    occupancy.to_binary()
    points = np.zeros((2, POINT_FIELDS))
    points[1, :2] = 1.0
    for way in (points, NO_PLAN.points):
        way.setflags(write=False)
        time_to_collision(way, 0.0, occupancy)


def main(setup: NodeSetup, proxy: NodeLink, stats: SharedStats) -> None:
    """Take up the newest frame whenever free."""
    mapping = setup.spec.mapping
    occupancy, counter = OccupancyMap(mapping.resolution_m, mapping.range_m), CollisionCounter()
    with join(setup, proxy, stats) as node:
        depth, odometry = node.input("depth", depth_array), node.input("odometry", state)
        camera, trajectory = node.input("camera_info", pinhole), node.input("trajectory", plan)
        node.ready()
        for frame in node.spin(depth):
            image, pose, lens = depth.read(frame), odometry.at(frame.ready_ns), camera.latest
            if image is None or pose is None or lens is None:
                continue
            view = View(frame.ready_ns - setup.spec.link.delay_ns, image, pose, lens)
            flown = NO_PLAN if trajectory.latest is None else trajectory.latest
            # No newer frame is there to recompute from: none is exposed while the stage is busy.
            (_, counter), check = node.recovery.sound(
                "collision_check",
                partial(perceive, node, view, flown, occupancy, counter),
                itemgetter(0),
                shown_verdict,
                instead={"stop": partial(imminent, node, flown, counter)},
            )
            node.put("collision_check", check)


class View(NamedTuple):
    """A frame, and from where and through what it was seen."""

    seen_ns: int
    depth: NDArray[np.float32]
    pose: VehicleState
    lens: Pinhole


def imminent(node: Node, flown: Plan, before: CollisionCounter) -> tuple[Any, CollisionCounter]:
    """A verdict that has the vehicle stop: it collides at once, on whatever it flies."""
    counter = copy(before)
    found = counter.update(flown.trajectory_seq, flown.future_collision_seq, collision=True)
    return check_message(header(node.now_ns, frames.MAP), flown, found, 0.0), counter


def perceive(
    node: Node, view: View, flown: Plan, occupancy: OccupancyMap, before: CollisionCounter
) -> tuple[Any, CollisionCounter]:
    """The verdict on ``flown`` after this frame, and the count of collisions with it.

    May be called again: the frame is then in the map twice, the count is not.
    """
    pose, (fx, fy, cx, cy) = view.pose, view.lens
    with node.kernel("point_cloud"):
        points, misses = point_cloud(view.depth, fx, fy, cx, cy, occupancy.range_m)
    published = node.put("cloud", cloud_message(header(view.seen_ns, frames.CAMERA_OPTICAL), points))
    with node.kernel("octomap"):
        scan = in_world(cloud_points(published), misses, pose.position, pose.attitude)
        occupancy.insert(scan, pose.position)
    node.put("map", map_message(header(view.seen_ns, frames.MAP), occupancy))
    checked_ns = node.now_ns
    with node.kernel("collision_check"):
        left_s = time_to_collision(flown.points, checked_ns / 1e9, occupancy)
    counter = copy(before)
    found = counter.update(flown.trajectory_seq, flown.future_collision_seq, collision=isfinite(left_s))
    return check_message(header(checked_ns, frames.MAP), flown, found, left_s), counter
