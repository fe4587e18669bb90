"""The world in three dimensions with what flies in it (three.js, which comes with NiceGUI)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from nicegui import ui
from nicegui.elements.scene.objects.box import Box
from nicegui.elements.scene.objects.point_cloud import PointCloud
from nicegui.elements.scene.objects.sphere import Sphere
from numpy.typing import NDArray

from dashboard.web.charts.flight_style import GOLDEN, NEUTRAL, RECOMPUTED
from services.models.safety import BODY_RADIUS_M
from sim.world import World

Xyz = Sequence[float]
Floats = NDArray[np.float64]

SPACING_M = 0.15
"""Between two points of a path: near enough to look like a line."""

FRAMES_PER_S = 8
"""It is drawn all the time, and where there is no graphics card by the processor that also flies."""

MOVING = "#c26a1b"
"""Colour of obstacles that move."""

MOST_POINTS = 4000
MOST_BOXES = 600

_MARGIN, _LEAST_M = 1.6, 10.0
"""How much wider than a flight the view is, and how long it is taken to be at least."""

_VEHICLE_M = 0.9
"""Radius of a vehicle as drawn: three times its own, to be seen from afar."""


class SceneView:
    """Obstacles, paths and vehicles; drag to turn, wheel to come nearer.

    A page needs one only: browsers go on drawing a scene that was taken away.
    """

    def __init__(self, described: str) -> None:
        self._paths: dict[str, PointCloud] = {}
        self._vehicles: dict[str, Sphere] = {}
        self._world: World | None = None
        self._moving: list[Box] = []
        self.element = ui.scene(grid=False, background_color="#9fb3c8", fps=FRAMES_PER_S).classes("scene")
        self.element.props('role="img"').props["aria-label"] = described

    def draw_world(self, world: World, around: Floats | None = None) -> None:
        """Draw a world in the place of all that was drawn.

        ``around`` (n, 3): what is looked at at first, such as a flight; else the whole world.
        """
        self.element.clear()
        self._paths.clear()
        self._vehicles.clear()
        self._world = world
        (left, south, floor), (right, north, _) = world.bounds.tolist()
        centre, span = ((left + right) / 2, (south + north) / 2), max(right - left, north - south)
        with self.element as scene:
            scene.box(right - left, north - south, 0.1).move(*centre, floor - 0.05).material("#e8ecf0")
            for box in world.fixed[:MOST_BOXES]:
                _box(scene, box, world).material("#6b7886", opacity=0.9)
            self._moving = [_box(scene, box, world).material(MOVING, opacity=0.9) for box in world.moved(0.0)]
            for end, colour in ((world.start, RECOMPUTED), (world.goal, GOLDEN)):
                x, y, z = end.tolist()
                scene.sphere(BODY_RADIUS_M).move(x, y, z).material(colour, opacity=0.25)
        if around is not None and len(around):
            low, high = around.min(axis=0), around.max(axis=0)
            centre = (float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2)
            span = min(span, _MARGIN * max(float(np.max((high - low)[:2])), _LEAST_M))
        x, y = centre
        scene.move_camera(x, y - 0.58 * span, 0.4 * span, x, y - 0.08 * span, 0.0, duration=0)

    def move_obstacles(self, time_s: float) -> None:
        """Have the obstacles that move be where they are at a virtual time."""
        if self._world is None or not self._moving:
            return
        for box, shown in zip(self._world.moved(time_s), self._moving, strict=True):
            shown.move(*_middle(_as_drawn(box, self._world)))

    def draw_path(self, name: str, points: Sequence[Xyz], colour: str) -> None:
        """Draw a path of that name, or draw it anew."""
        dense = resampled(np.asarray(points, dtype=np.float64).reshape(-1, 3)).round(2).tolist()
        if name in self._paths:
            self._paths[name].set_points(dense)
            return
        with self.element as scene:
            self._paths[name] = scene.point_cloud(dense, point_size=0.6).material(colour)

    def move(self, name: str, point: Xyz, colour: str = NEUTRAL) -> None:
        """Have the vehicle of that name be at ``point`` (x, y, z)."""
        if name not in self._vehicles:
            with self.element as scene:
                self._vehicles[name] = scene.sphere(_VEHICLE_M).material(colour)
        self._vehicles[name].move(*point)


def _as_drawn(box: Floats, world: World) -> Floats:
    """An obstacle up to the flight ceiling."""
    return np.minimum(box, [np.inf] * 5 + [world.bounds[1, 2]])


def _middle(box: Floats) -> tuple[float, float, float]:
    x0, y0, z0, x1, y1, z1 = box.tolist()
    return (x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2


def _box(scene: ui.scene, obstacle: Floats, world: World) -> Box:
    drawn = _as_drawn(obstacle, world)
    x0, y0, z0, x1, y1, z1 = drawn.tolist()
    box = scene.box(x1 - x0, y1 - y0, z1 - z0)
    box.move(*_middle(drawn))
    return box


def resampled(points: Floats) -> Floats:
    """``points`` (n, 3) along the same way, :data:`SPACING_M` apart or as many as there may be."""
    if len(points) < 2:
        return points
    legs = np.linalg.norm(np.diff(points, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(legs)])
    count = int(min(max(way[-1] / SPACING_M, 1.0), MOST_POINTS - 1)) + 1
    at = np.linspace(0.0, way[-1], count)
    return np.column_stack([np.interp(at, way, points[:, axis]) for axis in range(3)])
