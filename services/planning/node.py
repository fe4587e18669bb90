"""Planning on the bus: decides verdict by verdict whether to plan, and publishes trajectories."""

from __future__ import annotations

from contextlib import nullcontext
from copy import copy
from functools import partial
from typing import Any

import numpy as np

from services.bus import frames
from services.bus.arrays import Floats, Plan, place, plan_message, sound_goal, sound_task, state, verdict
from services.bus.detector_protocol import shown_trajectory
from services.bus.messages import header
from services.bus.octomaps import MalformedMap, sound_map
from services.bus.proxy_link import NodeLink
from services.bus.topics import TOPICS
from services.kernels import GOAL_KERNELS
from services.planning.goals import GoalContext, Goals, goals, warm_up_goals
from services.planning.pilot import Navigator, PlanRequest, tactics
from services.planning.planners import PLANNERS, plan
from services.planning.trail import Trail
from services.planning.trajectory import HELD_STEP_S, STEP_S, Departure, trajectory
from services.planning.voxels import VoxelGrid, unpack
from services.runtime import rng
from services.runtime.node import Node
from services.runtime.realtime import join
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats

BACK_M = 10.0
"""How far back along the trail a vehicle flies."""


def warm_up() -> None:
    """Compile the kernels before there is a flight."""
    corner = np.array([12.0, 12.0, 6.0])
    unpack(b"", 1.0, np.zeros(3), corner)
    warm_up_goals()
    # A map of which one octant is occupied: a start beside it is blocked, one farther off is not.
    grid = unpack(b"\x02\x00", 1.0, -corner, corner)
    for position in (np.array([0.5, -2.5, -2.5]), np.array([5.0, 5.0, 2.0])):
        start = Departure(0.0, position, np.zeros(3), np.zeros(3), 0.0)
        for planner in PLANNERS:
            path = plan(planner, grid, position, corner - 2.0, 1)
            if path is not None:
                trajectory(path, start, grid)


def main(setup: NodeSetup, proxy: NodeLink, stats: SharedStats) -> None:
    """Take up the newest verdict whenever free."""
    navigator: Navigator | None = None
    aims: Goals | None = None
    trail = Trail()
    with join(setup, proxy, stats) as node:
        check, odometry = node.input("collision_check", verdict), node.input("odometry", state)
        octomap, goal = node.input("map", sound_map), node.input("goal", sound_goal)
        task = node.input("task", sound_task)
        node.ready()
        for checked in node.spin(check):
            found, now, known, aim = check.read(checked), odometry.latest, octomap.latest, goal.latest
            if found is None or now is None or known is None or aim is None:
                continue
            trail.add(now.position)
            if aims is None:
                aims = goals(node.spec.mission, place(aim, task.latest), node.spec.area.swath_m)
            try:
                aims, heading = guided(node, aims, navigator, now.position, known)
                if heading is None:
                    continue
                navigator = heading
                opening = navigator.opening(node.now_ns / 1e9, now.position, now.yaw, found)
                if opening is not None:
                    # No kernel runs, but nobody may see a trajectory sooner than one could.
                    made_after = node.spec.kernels_before(TOPICS["trajectory"])
                    node.now_ns += sum(node.timer.latency(name).least_ns for name in made_after)
                    _, hover = node.recovery.sound(
                        "trajectory", partial(opened, node, opening), lambda sent: sent, shown_trajectory
                    )
                    node.put("trajectory", hover)
                    continue
                request = navigator.consider(node.now_ns / 1e9, now.position, now.velocity, now.yaw, found)
                node.guards.take(navigator.acted)
                if request is None:
                    continue
                grid = unpack(known.data.tobytes(), known.resolution, *request.box())
            except MalformedMap:
                node.count("malformed")
                continue
            points, message = node.recovery.sound(
                "trajectory",
                partial(make, node, request, grid),
                partial(announced, node, request),
                shown_trajectory,
                instead={"stop": lambda: None, "trail": partial(back, node, request, grid, trail)},
            )
            message.failed = navigator.answer(request, points).failed
            node.put("trajectory", message)


def opened(node: Node, opening: Plan) -> Any:
    """The message of what a pilot flies first."""
    return plan_message(header(node.now_ns, frames.MAP), opening)


def guided(
    node: Node, aims: Goals, navigator: Navigator | None, position: Floats, octomap: Any
) -> tuple[Goals, Navigator | None]:
    """The goals, and the navigator on its way to the next one; None if there is none: the vehicle stays."""
    reached = False if navigator is None else navigator.arrival(node.now_ns / 1e9, position)
    if reached is None:
        return aims, navigator
    aims.look(position, octomap.data.tobytes(), octomap.resolution)
    decide = partial(chosen, node, aims, GoalContext(position, reached))
    if aims.chooses:
        aims, goal = node.recovery.decided("trajectory", decide, lambda both: both[0].decided())
    else:
        aims, goal = decide()
    if goal is None:
        return aims, None
    if navigator is None:
        latency_s = sum(node.timer.latency(name).slow_ns for name in (node.spec.planner, "trajectory")) / 1e9
        return aims, Navigator(goal, latency_s, tactics(node.spec))
    navigator.head_for(goal)
    return aims, navigator


def chosen(node: Node, aims: Goals, standing: GoalContext) -> tuple[Goals, Floats | None]:
    """The goals once the next one is chosen, and that one."""
    after = copy(aims)
    with node.kernel(GOAL_KERNELS[node.spec.mission]) if aims.chooses else nullcontext():
        return after, after.next(standing)


def make(node: Node, request: PlanRequest, grid: VoxelGrid) -> Floats | None:
    """The trajectory that is asked for, or None if there is no way."""
    seed = rng.native_seed(node.spec.seed, "planner", request.trajectory_seq)
    with node.kernel(node.spec.planner):
        path = plan(node.spec.planner, grid, request.departure.position, request.goal, seed, request.limit)
    return None if path is None else timed(node, request, grid, path)


def timed(node: Node, request: PlanRequest, grid: VoxelGrid, path: Floats) -> Floats | None:
    """The trajectory along a path (n, 3)."""
    with node.kernel("trajectory"):
        motion = node.spec.motion
        limits = motion.speed_m_s, motion.acceleration_m_s2
        step_s = STEP_S if "dense" in node.spec.active_guards else HELD_STEP_S
        return trajectory(path, request.departure, grid, request.limit, *limits, step_s)


def back(node: Node, request: PlanRequest, grid: VoxelGrid, trail: Trail) -> Floats | None:
    """A trajectory back along the way that the vehicle came, or None if it has come none."""
    path = trail.back(request.departure.position, BACK_M)
    return None if path is None else timed(node, request, grid, path)


def announced(node: Node, request: PlanRequest, points: Floats | None) -> Any:
    """The message of what was made, the mission not being given up."""
    return plan_message(header(node.now_ns, frames.MAP), request.plan(points))
