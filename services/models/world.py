"""What a world is made from: the one definition, shared by files, specifications and the simulator.

World frame: x east, y north, z up, metres. ``sim.world`` makes a world out of it.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, JsonValue

from services.models.base import Strict

Coordinate = Annotated[float, Field(ge=-100_000, le=100_000)]
"""Metres along one axis of the world."""

Point = tuple[Coordinate, Coordinate, Coordinate]
Box = tuple[float, float, float, float, float, float]

DRAWN_TOP_M = 20.0
"""Height of a drawn obstacle, for the paper's "unbounded": twice the flight ceiling."""


MOST_BOXES = 100_000
"""Boxes of a world at most."""

MOST_CANDIDATES = 100_000
"""Places for obstacles that one draw of a world considers, at most."""


class Surroundings(Strict):
    """What all worlds have: a start, a goal and the space to fly in.

    The default goal is 50 m from the start (facts page, "mission"), along the middle of a row of cells:
    on the border between two rows obstacles would at most graze the straight line. The area is ten cells
    of 10 m by ten, the ceiling the planner's upper limit.
    """

    name: str = Field(min_length=1, max_length=60, pattern=r"^[A-Za-z0-9._-]+$")
    start: Point = (-25.0, 5.0, 2.0)
    goal: Point = (25.0, 5.0, 2.0)
    lower: Point = (-50.0, -50.0, 0.0)
    upper: Point = (50.0, 50.0, 10.0)


class GridWorld(Surroundings):
    """The paper's generator (section VI): obstacles scattered over the cells of a grid.

    ``density`` is the probability that a cell holds an obstacle, ``obstacle_m`` the side of its square
    cross-section.
    """

    kind: Literal["grid"]
    density: float = Field(ge=0, le=1)
    obstacle_m: float = Field(ge=0.01, le=1000)
    cell_m: float = Field(default=10.0, ge=0.01, le=1000)


class ClusteredWorld(Surroundings):
    """Gaussian congestion, after MAVBench's environment generator.

    An obstacle is as probable as ``density`` at a centroid (x, y) and less by a Gaussian of standard
    deviation ``spread_m`` away from the nearest one. At least ``gap_m`` is free between two obstacles.
    """

    kind: Literal["clustered"]
    centroids: tuple[tuple[float, float], ...] = Field(min_length=1, max_length=100)
    spread_m: float = Field(gt=0, le=1000)
    density: float = Field(ge=0, le=1)
    obstacle_m: float = Field(ge=0.01, le=1000)
    gap_m: float = Field(ge=0, le=1000)


class _GradedWorld(Surroundings):
    """Generators with a difficulty: other parameters follow from it unless they are given.

    The area is what the planner searches: 25 m beyond start and goal (``services/planning/pilot.py``).
    """

    lower: Point = (-40.0, -20.0, 0.0)
    upper: Point = (40.0, 30.0, 10.0)
    difficulty: float = Field(default=0.5, ge=0, le=1)


class ForestWorld(_GradedWorld):
    """Thin and cluttered: trees with trunks of ``trunk_m`` at least ``gap_m`` apart, and level branches.

    Trunks and branches are square; ``branches`` is the mean number at a tree.
    """

    kind: Literal["forest"]
    stems_per_ha: float | None = Field(default=None, gt=0, le=10_000)
    trunk_m: float | None = Field(default=None, ge=0.02, le=10)
    gap_m: float | None = Field(default=None, ge=0, le=100)
    branches: float | None = Field(default=None, ge=0, le=20)


class GatesWorld(_GradedWorld):
    """A hall with walls across the way and one gate in each.

    A gate is ``clearance_m`` wider than the safety body on either side, its middle up to ``shift_m``
    beside the straight way.
    """

    kind: Literal["gates"]
    walls: int | None = Field(default=None, ge=1, le=20)
    clearance_m: float | None = Field(default=None, ge=0, le=20)
    shift_m: float | None = Field(default=None, ge=0, le=1000)


class TrafficWorld(_GradedWorld):
    """Obstacles that cross the way back and forth, at up to ``speed_m_s``, among pillars that stand."""

    kind: Literal["traffic"]
    movers: int | None = Field(default=None, ge=1, le=100)
    speed_m_s: float | None = Field(default=None, gt=0, le=20)
    obstacle_m: float = Field(default=1.5, gt=0, le=100)
    pillars: int = Field(default=4, ge=0, le=1000)


class MovingBox(Strict):
    """A box that goes back and forth at a constant speed.

    ``box`` is where it is at one end of its line, ``travel_m`` the way from there to the other end. It
    takes ``period_s`` to go and come back; at time 0 it is ``phase`` of a period after that end.
    """

    box: Box
    travel_m: Point
    period_s: float = Field(gt=0, le=1e6)
    phase: float = Field(default=0.0, ge=0, lt=1)


class GeneratedWorld(Surroundings):
    """A world of a generator that another package adds, of the group ``zenfi.worlds``.

    ``parameters`` are the generator's own; those that are left out have its defaults.
    """

    kind: Literal["generated"]
    generator: str = Field(min_length=1, max_length=60)
    parameters: dict[str, JsonValue] = Field(default={}, max_length=100)


class BoxWorld(Surroundings):
    """A world made by hand or exported: axis-aligned boxes, lower corner x y z, upper corner x y z."""

    kind: Literal["boxes"]
    boxes: tuple[Box, ...] = Field(max_length=MOST_BOXES)
    moving: tuple[MovingBox, ...] = Field(default=(), max_length=1000)


WorldDefinition = Annotated[
    GridWorld | ClusteredWorld | ForestWorld | GatesWorld | TrafficWorld | GeneratedWorld | BoxWorld,
    Field(discriminator="kind"),
]
