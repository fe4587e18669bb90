"""A flight in one process: the stages' kernels around a kinematic vehicle among boxes.

Latencies and periods are virtual and stand where the bus would put them, so that what is tuned here
holds on the bus. Nothing of it is used by the product.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.bus.arrays import NO_PLAN, Plan, Verdict
from services.control.following import follower
from services.models.mission import MissionSpec
from services.perception.collision import CollisionCounter, time_to_collision
from services.perception.occupancy import OccupancyMap
from services.perception.point_cloud import in_world, point_cloud
from services.planning.pilot import Navigator, PlanRequest, Tactics
from services.planning.planners import plan
from services.planning.trajectory import trajectory
from services.planning.voxels import unpack
from services.runtime.rng import generator, native_seed

WIDTH, HEIGHT = 64, 36
FOCAL_PX = WIDTH / 2  # 90 deg
TICK_S = 0.04
SUBSTEPS = 10
LAG_S = 0.25
ACCELERATION_M_S2 = 8.0
HULL_M = 0.5
START = np.array([0.0, 0.0, 3.0])
GOAL = np.array([50.0, 0.0, 3.0])
ARRIVED_M = 1.0

Boxes = NDArray[np.float64]


@dataclass(frozen=True)
class Latencies:
    """Virtual compute times, s."""

    perception_s: float = 0.32
    planning_s: float = 0.083


@dataclass
class Flight:
    """What became of a flight."""

    result: str = "timeout"
    time_s: float = 0.0
    distance_m: float = 0.0
    clearance_m: float = math.inf
    plans: int = 0
    failures: int = 0
    trace: list[NDArray[np.float64]] = field(default_factory=list)


def scattered(seed: int, probability: float, size_m: float) -> Boxes:
    """100 x 100 m around the middle of the way, 10 m cells, each with a box with ``probability``.

    Rows (x low, x high, y low, y high). Start and goal keep 3 m around them.
    """
    draw = generator(seed, "boxes")
    boxes = []
    for x in np.arange(-25.0, 75.0, 10.0):
        for y in np.arange(-55.0, 45.0, 10.0):
            place = draw.random(3)
            if place[0] < probability:
                left, low = x + place[1] * (10.0 - size_m), y + place[2] * (10.0 - size_m)
                boxes.append((left, left + size_m, low, low + size_m))
    rows = np.array(boxes).reshape(-1, 4)
    near = [_distance(rows, end[0], end[1]) < 3.0 for end in (START, GOAL)]
    return rows[~(near[0] | near[1])]


def wall(half_width_m: float = 12.0) -> Boxes:
    """A wall across the way."""
    return np.array([[24.0, 25.0, -half_width_m, half_width_m]])


def fly(
    boxes: Boxes,
    seed: int,
    planner: str = "rrt_star",
    latencies: Latencies | None = None,
    limit_s: float = 120.0,
) -> Flight:
    """Fly from START to GOAL."""
    return Loop(boxes, seed, planner, latencies or Latencies()).run(limit_s)


class Loop:
    """The stages and the vehicle, stepped tick by tick."""

    def __init__(self, boxes: Boxes, seed: int, planner: str, latencies: Latencies) -> None:
        self.boxes, self.seed, self.planner, self.latencies = boxes, seed, planner, latencies
        self.tick, self.now = 0, 0.0
        self.position, self.velocity, self.yaw = START.copy(), np.zeros(3), 0.0
        self.flight = Flight()
        self.occupancy = OccupancyMap()
        self.counter = CollisionCounter()
        self.navigator = Navigator(GOAL, latencies.planning_s, Tactics())
        self.follower = follower(MissionSpec())
        self.published = NO_PLAN
        self.perceived: tuple[float, Verdict, bytes] | None = None
        self.planned: tuple[float, Plan] | None = None

    def run(self, limit_s: float) -> Flight:
        """Until the goal, a collision, a giving up or the time limit; may be called again to go on."""
        while self.flight.result == "timeout" and self.tick * TICK_S < limit_s:
            self.now = self.tick * TICK_S
            self.perceive()
            self.plan()
            self.move()
            self.tick += 1
        self.flight.time_s = self.now
        return self.flight

    def perceive(self) -> None:
        """Deliver the verdict that is ready and start on the newest frame."""
        if self.perceived is not None and self.now < self.perceived[0]:
            return
        if self.perceived is not None:
            _, verdict, payload = self.perceived
            self.follower.take_verdict(*verdict)
            self.decide(verdict, payload)
        depth = render(self.boxes, self.position, self.yaw)
        orientation = np.array([math.cos(self.yaw / 2), 0.0, 0.0, math.sin(self.yaw / 2)])
        centre = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
        scan = point_cloud(depth, FOCAL_PX, FOCAL_PX, *centre, self.occupancy.range_m)
        self.occupancy.insert(in_world(*scan, self.position, orientation), self.position)
        seq, answered, trajectory_points, _ = self.published
        ahead = time_to_collision(trajectory_points, self.now, self.occupancy)
        count = self.counter.update(seq, answered, collision=math.isfinite(ahead))
        verdict = Verdict(self.now, seq, count, ahead)
        self.perceived = (self.now + self.latencies.perception_s, verdict, self.occupancy.to_binary())

    def decide(self, verdict: Verdict, payload: bytes) -> None:
        """Start planning if it is free and the navigator wants it."""
        if self.planned is not None:
            return
        request = self.navigator.consider(self.now, self.position, self.velocity, self.yaw, verdict)
        if request is not None:
            answer = self.navigator.answer(request, self.solve(request, payload))
            self.planned = (self.now + self.latencies.planning_s, answer)
            self.flight.plans += 1
            self.flight.failures += len(answer.points) == 0

    def solve(self, request: PlanRequest, payload: bytes) -> NDArray[np.float64] | None:
        """The planning kernels, one after the other."""
        grid = unpack(payload, self.occupancy.resolution_m, *request.box())
        seed = native_seed(self.seed, "planner", request.trajectory_seq)
        path = plan(self.planner, grid, request.departure.position, request.goal, seed, request.limit)
        if path is None:
            return None
        return trajectory(path, request.departure, grid, request.limit)

    def plan(self) -> None:
        """Deliver the trajectory that is ready."""
        if self.planned is not None and self.now >= self.planned[0]:
            self.published, self.planned = self.planned[1], None
            self.follower.take_trajectory(*self.published[:3])
            if self.published.failed:
                self.flight.result = "no_path"

    def move(self) -> None:
        """Control and the vehicle for one tick: first-order lag of velocity, limited acceleration."""
        command = self.follower.command(self.now, self.position, self.velocity, self.yaw, TICK_S)
        for _ in range(SUBSTEPS):
            step = TICK_S / SUBSTEPS
            pull = (command[:3] - self.velocity) / LAG_S
            pull *= min(1.0, ACCELERATION_M_S2 / max(float(np.linalg.norm(pull)), 1e-9))
            self.velocity = self.velocity + pull * step
            self.position = self.position + self.velocity * step
            self.flight.distance_m += float(np.linalg.norm(self.velocity)) * step
        self.yaw = math.remainder(self.yaw + command[3] * TICK_S, math.tau)
        self.flight.trace.append(np.array([self.now, *self.position, *self.velocity, self.yaw]))
        gaps = _distance(self.boxes, self.position[0], self.position[1])
        gap = min(float(gaps.min(initial=math.inf)), float(self.position[2])) - HULL_M
        self.flight.clearance_m = min(self.flight.clearance_m, gap)
        if gap <= 0.0:
            self.flight.result = "collision"
        elif np.linalg.norm(self.position - GOAL) < ARRIVED_M:
            self.flight.result = "success"


def _distance(boxes: Boxes, x: float, y: float) -> NDArray[np.float64]:
    """Horizontal distance from a point to each box."""
    dx = np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 1]), 0.0)
    dy = np.maximum(np.maximum(boxes[:, 2] - y, y - boxes[:, 3]), 0.0)
    return np.asarray(np.hypot(dx, dy))


@njit(cache=True)
def render(boxes: Boxes, position: NDArray[np.float64], yaw: float) -> NDArray[np.float32]:
    """Z-depth image (HEIGHT, WIDTH) of boxes without a top and of the ground, level camera."""
    depth = np.full((HEIGHT, WIDTH), np.inf, dtype=np.float32)
    cos, sin = math.cos(yaw), math.sin(yaw)
    for u in range(WIDTH):
        side = -(u - (WIDTH - 1) / 2) / FOCAL_PX
        dx, dy = cos - sin * side, sin + cos * side
        wall_at = np.inf
        for b in range(len(boxes)):
            x0, x1 = (boxes[b, 0] - position[0]) / dx, (boxes[b, 1] - position[0]) / dx
            y0, y1 = (boxes[b, 2] - position[1]) / dy, (boxes[b, 3] - position[1]) / dy
            near = max(min(x0, x1), min(y0, y1))
            far = min(max(x0, x1), max(y0, y1))
            if 0.0 < near <= far:
                wall_at = min(wall_at, near)
        for v in range(HEIGHT):
            lift = -(v - (HEIGHT - 1) / 2) / FOCAL_PX
            ground_at = position[2] / -lift if lift < 0.0 else np.inf
            depth[v, u] = min(wall_at, ground_at)
    return depth
