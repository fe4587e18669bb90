"""Worlds: bounds, obstacles, start and goal of a mission, made from a definition and a seed.

World frame: x east, y north, z up, metres.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from services.models.base import first_problem
from services.models.plug_ins import WorldGenerator
from services.models.safety import BODY_RADIUS_M
from services.models.world import (
    DRAWN_TOP_M,
    MOST_BOXES,
    MOST_CANDIDATES,
    BoxWorld,
    ClusteredWorld,
    ForestWorld,
    GatesWorld,
    GeneratedWorld,
    GridWorld,
    Point,
    TrafficWorld,
    WorldDefinition,
)
from services.runtime.rng import generator
from services.system import plug_ins
from sim.generators import TRIES, Scattered, forest_stems, scatter_forest, scatter_gates, scatter_traffic
from sim.moving import NONE_MOVING, rows_of, swept

Floats = NDArray[np.float64]

KEEP_OUT_M = 3.0
"""No drawn obstacle stands closer to start or goal: the safety body and as much again."""

ATTEMPTS = 1000
"""Draws after which a world that leaves the straight way free is given up."""

CONSIDERED = 2_000_000
"""Places for obstacles, of all draws together, after which such a world is given up as well."""

DrawnWorld = GridWorld | ClusteredWorld | ForestWorld | GatesWorld | TrafficWorld | GeneratedWorld

DEFINITION: TypeAdapter[WorldDefinition] = TypeAdapter(WorldDefinition)


class BadWorldError(ValueError):
    """No world of that name, or a definition that no world can be made of."""


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A mission's surroundings. All arrays are float64 and read-only.

    ``bounds`` is (2, 3): lower and upper corner of the space to fly in. ``obstacles`` is (n, 6):
    lower corner x y z, upper corner x y z of axis-aligned boxes at time 0. The last m of them move, as
    ``moving`` (m, 11) says (``sim/moving.py``). ``start`` and ``goal`` are (3,).
    """

    name: str
    seed: int
    bounds: Floats
    obstacles: Floats
    start: Floats
    goal: Floats
    moving: Floats = field(default_factory=lambda: NONE_MOVING)

    def __post_init__(self) -> None:
        for array in (self.bounds, self.obstacles, self.start, self.goal, self.moving):
            array.setflags(write=False)

    @property
    def fixed(self) -> Floats:
        """The obstacles that stand, (n - m, 6)."""
        return self.obstacles[: len(self.obstacles) - len(self.moving)]

    def moved(self, time_s: float) -> Floats:
        """The boxes of the moving obstacles at a virtual time, (m, 6)."""
        return _boxes_at(self.moving, time_s)


def _boxes_at(moving: Floats, time_s: float) -> Floats:
    from sim.moving_boxes import boxes_at  # noqa: PLC0415 - numba is slow to import; most worlds stand still

    boxes: Floats = boxes_at(moving, time_s)
    return boxes


def world_names() -> list[str]:
    """The worlds that can be flown in by name: those that come along, then those that other packages add."""
    return [*own_worlds(), *(name for name in plug_ins.names("worlds") if name not in own_worlds())]


def own_worlds() -> list[str]:
    """The worlds that come along, sorted."""
    names = (entry.name for entry in (files("sim") / "worlds").iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


@cache
def definition(name: str) -> WorldDefinition:
    """The definition of that name.

    :raises BadWorldError: if there is none.
    """
    if name not in own_worlds():
        if plug_ins.is_installed("worlds", name):
            return GeneratedWorld(name=name, kind="generated", generator=name)
        raise BadWorldError(plug_ins.unknown("worlds", name, own_worlds()))
    return DEFINITION.validate_python(tomllib.loads((files("sim") / "worlds" / f"{name}.toml").read_text()))


def make_world(asked: str | WorldDefinition, seed: int) -> World:
    """The world of a name or a definition as drawn from ``seed``: the same arguments give the same bytes.

    At the paper's density of one cell in twenty most draws leave the straight line from start to
    goal free, and on such a flight neither collision check nor replanning has anything to do. So a
    draw counts only if that line comes within the safety radius of an obstacle; else the next
    attempt is drawn, with a stream of its own. Worlds made by hand are the same for every seed.

    :raises BadWorldError: naming what is wrong and its value.
    """
    wanted = definition(asked) if isinstance(asked, str) else asked
    _refuse_bad_area(wanted)
    start, goal = np.array(wanted.start), np.array(wanted.goal)
    made = _given(wanted) if isinstance(wanted, BoxWorld) else _drawn(wanted, seed, start, goal)
    obstacles = np.vstack([made.fixed, _boxes_at(made.moving, 0.0)]) if len(made.moving) else made.fixed
    bounds = np.array([wanted.lower, wanted.upper])
    return World(wanted.name, seed, bounds, obstacles, start, goal, made.moving)


def _refuse_bad_area(wanted: WorldDefinition) -> None:
    for low, high, axis in zip(wanted.lower, wanted.upper, "xyz", strict=True):
        if low >= high:
            message = f"world {wanted.name}: lower {axis} {low:g} is not below upper {axis} {high:g}"
            raise BadWorldError(message)
    for what, place in (("start", wanted.start), ("goal", wanted.goal)):
        if not _within(place, wanted.lower, wanted.upper):
            message = f"world {wanted.name}: {what} {_text(place)} is outside the area"
            raise BadWorldError(message)


def _within(place: Point, lower: Sequence[float], upper: Sequence[float]) -> bool:
    return all(low < value < high for low, value, high in zip(lower, place, upper, strict=True))


def _given(wanted: BoxWorld) -> Scattered:
    """The boxes of a world made by hand."""
    moving = rows_of(wanted.moving)
    boxes = {f"boxes.{index}": box for index, box in enumerate(wanted.boxes)}
    _refuse_bad_boxes(wanted, boxes)
    _refuse_bad_boxes(wanted, {f"moving.{index}.box": one.box for index, one in enumerate(wanted.moving)})
    ways = {f"the way of moving.{index}": tuple(box) for index, box in enumerate(swept(moving).tolist())}
    _refuse_bad_boxes(wanted, ways)
    if not boxes and not wanted.moving:
        message = f"world {wanted.name}: boxes []: a world without obstacles"
        raise BadWorldError(message)
    return Scattered(np.array(wanted.boxes, dtype=np.float64).reshape(-1, 6), moving)


def _refuse_bad_boxes(wanted: BoxWorld, boxes: Mapping[str, tuple[float, ...]]) -> None:
    for named, box in boxes.items():
        low, high = box[:3], box[3:]
        if any(below >= above for below, above in zip(low, high, strict=True)):
            message = f"world {wanted.name}: {named} {_text(box)}: lower corner not below the upper"
            raise BadWorldError(message)
        for what, place in (("start", wanted.start), ("goal", wanted.goal)):
            if _within(place, low, high):
                message = f"world {wanted.name}: {what} {_text(place)} is inside {named} {_text(box)}"
                raise BadWorldError(message)


def _drawn(wanted: DrawnWorld, seed: int, start: Floats, goal: Floats) -> Scattered:
    """Obstacles with start and goal kept free and something in the straight way."""
    if isinstance(wanted, GridWorld | ClusteredWorld) and wanted.density == 0.0:
        message = f"world {wanted.name}: density 0: a world without obstacles"
        raise BadWorldError(message)
    scatter = GENERATORS[wanted.kind]
    attempts = min(ATTEMPTS, CONSIDERED // _candidates(wanted))
    for attempt in range(attempts):
        drawn = scatter(wanted, generator(seed, f"world {wanted.name}", attempt))
        near = _near_the_ends(drawn.fixed, start, goal)
        fixed = np.ascontiguousarray(drawn.fixed[~near])
        moving = np.ascontiguousarray(drawn.moving[~_near_the_ends(swept(drawn.moving), start, goal)])
        if meets(np.vstack([fixed, swept(moving)]), start, goal, BODY_RADIUS_M).any():
            return Scattered(fixed, moving)
    what = ", ".join(f"{name} {value:g}" for name, value in wanted if name in _STATED and value is not None)
    message = f"world {wanted.name}: {what}: none of {attempts} draws puts an obstacle in the straight way"
    raise BadWorldError(message)


def _candidates(wanted: DrawnWorld) -> int:
    """How many places for obstacles a draw considers.

    :raises BadWorldError: if it is more than can be drawn in reasonable time and memory.
    """
    match wanted:
        case GridWorld():
            count = math.prod(_cells(wanted, wanted.cell_m))
        case ClusteredWorld():
            count = math.prod(_cells(wanted, wanted.obstacle_m + wanted.gap_m)) * len(wanted.centroids)
        case ForestWorld():
            count = forest_stems(wanted) * TRIES
        case _:
            count = 1
    if count > MOST_CANDIDATES:
        message = (
            f"world {wanted.name}: {count} places for obstacles, at most {MOST_CANDIDATES} are allowed: "
            "make the area smaller, or obstacles larger or fewer"
        )
        raise BadWorldError(message)
    return max(count, 1)


def _near_the_ends(boxes: Floats, start: Floats, goal: Floats) -> NDArray[np.bool_]:
    return meets(boxes, start, start, KEEP_OUT_M) | meets(boxes, goal, goal, KEEP_OUT_M)


def _scatter_grid(grid: GridWorld, rng: np.random.Generator) -> Scattered:
    """Boxes, each at a uniform position inside its cell, in the order of the cells."""
    if grid.obstacle_m > grid.cell_m:
        message = f"world {grid.name}: obstacle_m {grid.obstacle_m:g} does not fit cell_m {grid.cell_m:g}"
        raise BadWorldError(message)
    columns, rows = _cells(grid, grid.cell_m)
    occupied = rng.random((columns, rows)) < grid.density
    offset = rng.uniform(0.0, grid.cell_m - grid.obstacle_m, (columns, rows, 2))
    corner = np.argwhere(occupied) * grid.cell_m + np.array(grid.lower[:2]) + offset[occupied]
    return Scattered(_towers(grid, corner))


def _scatter_clusters(wanted: ClusteredWorld, rng: np.random.Generator) -> Scattered:
    """Boxes on a grid whose cells hold an obstacle and half a gap on each side."""
    pitch = wanted.obstacle_m + wanted.gap_m
    columns, rows = _cells(wanted, pitch)
    # The grid begins anywhere within its first cell, or its rows would be the same in every draw.
    origin = np.array(wanted.lower[:2]) - rng.uniform(0.0, wanted.gap_m, 2) / 2
    corner = origin + np.indices((columns, rows)).transpose(1, 2, 0) * pitch + wanted.gap_m / 2
    centre = corner + wanted.obstacle_m / 2
    off = np.linalg.norm(centre[:, :, None, :] - np.array(wanted.centroids), axis=-1).min(axis=-1)
    probability = wanted.density * np.exp(-0.5 * (off / wanted.spread_m) ** 2)
    return Scattered(_towers(wanted, corner[rng.random((columns, rows)) < probability]))


def _scatter_generated(wanted: GeneratedWorld, rng: np.random.Generator) -> Scattered:
    """Boxes of a generator that another package adds.

    :raises BadWorldError: naming the generator and what is wrong with its parameters, or with what it draws.
    """
    what = f"world {wanted.name}: generator {wanted.generator}"
    added: WorldGenerator = plug_ins.load("worlds", wanted.generator)
    try:
        parameters = added.parameters.model_validate(wanted.parameters)
    except ValidationError as error:
        message = f"{what}: parameters.{first_problem(error)}"
        raise BadWorldError(message) from error
    boxes = np.array(added.draw(wanted, parameters, rng), dtype=np.float64)
    if boxes.ndim != 2 or boxes.shape[1] != 6 or not 0 < len(boxes) <= MOST_BOXES:
        message = f"{what} drew an array {boxes.shape}, not (n, 6) with n from 1 to {MOST_BOXES}"
        raise BadWorldError(message)
    bad = np.flatnonzero(~(np.isfinite(boxes).all(axis=1) & (boxes[:, :3] < boxes[:, 3:]).all(axis=1)))
    if len(bad):
        message = f"{what} drew {_text(boxes[bad[0]].tolist())}: lower corner not below the upper"
        raise BadWorldError(message)
    return Scattered(boxes)


def _cells(wanted: GridWorld | ClusteredWorld, cell_m: float) -> tuple[int, int]:
    """How many cells fit the area along x and y."""
    width, depth = (wanted.upper[axis] - wanted.lower[axis] for axis in (0, 1))
    columns, rows = int(width / cell_m + 1e-9), int(depth / cell_m + 1e-9)
    if columns < 1 or rows < 1:
        message = f"world {wanted.name}: a cell of {cell_m:g} m does not fit {width:g} m by {depth:g} m"
        raise BadWorldError(message)
    return columns, rows


def _towers(wanted: GridWorld | ClusteredWorld, corner: Floats) -> Floats:
    """Square towers (n, 6) on the ground from lower corners (n, 2)."""
    ground = np.full((len(corner), 1), wanted.lower[2])
    return np.hstack([corner, ground, corner + wanted.obstacle_m, ground + DRAWN_TOP_M])


GENERATORS: Mapping[str, Callable[[Any, np.random.Generator], Scattered]] = MappingProxyType(
    {
        "grid": _scatter_grid,
        "clustered": _scatter_clusters,
        "forest": scatter_forest,
        "gates": scatter_gates,
        "traffic": scatter_traffic,
        "generated": _scatter_generated,
    }
)
"""By kind: what draws the obstacles of a world."""

_STATED = ("density", "obstacle_m", "difficulty", "stems_per_ha", "clearance_m", "movers")


def _text(numbers: Sequence[float]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in numbers) + "]"


def meets(obstacles: Floats, a: Floats, b: Floats, margin_m: float) -> NDArray[np.bool_]:
    """For each box, whether the segment from ``a`` to ``b`` meets the box grown by ``margin_m``."""
    direction = b - a
    still = direction == 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (obstacles[:, :3] - margin_m - a) / direction
        second = (obstacles[:, 3:] + margin_m - a) / direction
    # An axis along which the segment does not move limits it nowhere or everywhere.
    inside = (obstacles[:, :3] - margin_m <= a) & (a <= obstacles[:, 3:] + margin_m)
    enter = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(first, second))
    leave = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(first, second))
    met: NDArray[np.bool_] = np.maximum(enter.max(axis=1), 0.0) <= np.minimum(leave.min(axis=1), 1.0)
    return met


def to_toml(world: World) -> str:
    """The file of a world: a definition by boxes that makes the same world, byte for byte."""

    def numbers(values: Floats) -> str:
        return "[" + ", ".join(map(repr, values.tolist())) + "]"

    lines = [
        f'name = "{world.name}"',
        'kind = "boxes"',
        f"start = {numbers(world.start)}",
        f"goal = {numbers(world.goal)}",
        f"lower = {numbers(world.bounds[0])}",
        f"upper = {numbers(world.bounds[1])}",
        "boxes = [",
        *(f"  {numbers(box)}," for box in world.fixed),
        "]",
    ]
    for one in world.moving:
        lines += [
            "",
            "[[moving]]",
            f"box = {numbers(one[:6])}",
            f"travel_m = {numbers(one[6:9])}",
            f"period_s = {float(one[9])!r}",
            f"phase = {float(one[10])!r}",
        ]
    lines.append("")
    return "\n".join(lines)
