"""The plan of a world with what flies in it: layers of SVG over one another, north up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from nicegui import ui

from dashboard.analysis.plan import moving_shapes, shapes, svg_elements, view_box
from dashboard.web.charts.flight_style import ALARM
from dashboard.web.charts.scene_view import Floats
from sim.world import World

Xy = Sequence[float]
"""x and y first, m; what follows is left alone."""

ROOM_M = 8.0
"""Beside a flight that a plan is drawn around."""

LAYERS = ("ground", "map", "paths", "now")
"""From the ground up."""


class PlanView:
    """A plan whose layers can be drawn anew; what is put in is made of numbers, by the functions below.

    ``around`` (n, 3): what it shows with some room, such as a flight; else the whole world.
    """

    def __init__(self, world: World, described: str, around: Floats | None = None) -> None:
        self._box = view_box(world) if around is None or not len(around) else _box_around(around)
        self._bounds = world.bounds[:, :2].tolist()
        _, _, width, height = self._box
        with (
            ui.element("div")
            .classes("plan")
            .style(f"aspect-ratio: {width:g} / {height:g}")
            .props('role="img"') as self.element
        ):
            self.element.props["aria-label"] = described
            self._layers = {
                name: ui.html("", sanitize=False).classes(f"layer layer-{name}") for name in LAYERS
            }
        ends = (_named(world.start.tolist(), "start"), _named(world.goal.tolist(), "goal"))
        self.draw("ground", *svg_elements(shapes(world, None)), *ends)

    def draw(self, layer: str, *shapes: str) -> None:
        """Replace the content of a layer."""
        view = " ".join(f"{number:g}" for number in self._box)
        self._layers[layer].set_content(
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{view}" aria-hidden="true">'
            f"{''.join(shapes)}</svg>"
        )

    def draw_map(self, picture: str | None) -> None:
        """Lay a picture of the world's bounds, a data URL, over the ground."""
        (left, south), (right, north) = self._bounds
        size = f'x="{left}" y="{-north}" width="{right - left}" height="{north - south}"'
        form = 'preserveAspectRatio="none" style="image-rendering: pixelated"'
        self.draw("map", f'<image {size} {form} href="{picture}"/>' if picture else "")


def _box_around(points: Floats) -> tuple[float, float, float, float]:
    """Left, top, width and height of what holds ``points``, m; y grows downwards. Not flatter than 3 to 2."""
    (left, south), (right, north) = points[:, :2].min(axis=0) - ROOM_M, points[:, :2].max(axis=0) + ROOM_M
    width, height = float(right - left), float(north - south)
    wider, higher = max(width, height), max(height, width / 1.5)
    return float(left + right - wider) / 2, -float(south + north + higher) / 2, wider, higher


def _named(point: Xy, name: Literal["start", "goal"]) -> str:
    """The name of a place, above it: its colour alone does not tell."""
    x, y = point[0], -point[1]
    style = (
        'font-size="3" text-anchor="middle" fill="#222" stroke="#fff" stroke-width="0.6" paint-order="stroke"'
    )
    return f'<text x="{x:.2f}" y="{y - 1.8:.2f}" {style}>{name}</text>'


def path(points: Sequence[Xy], colour: str, *, dashed: bool = False) -> str:
    """Draw a line through ``points``."""
    places = " ".join(f"{x:.2f},{-y:.2f}" for x, y, *_ in points)
    dashes = ' stroke-dasharray="1.6 1"' if dashed else ""
    return (
        f'<polyline points="{places}" fill="none" stroke="{colour}" stroke-width="0.6"'
        f' stroke-linejoin="round"{dashes}/>'
    )


def moving_obstacles(world: World, time_s: float) -> list[str]:
    """Draw the obstacles that move, where they are at a virtual time."""
    return svg_elements(moving_shapes(world, time_s))


def vehicle(point: Xy, colour: str) -> str:
    """Mark the position of a vehicle."""
    x, y = point[0], -point[1]
    return f'<circle cx="{x:.2f}" cy="{y:.2f}" r="1.1" fill="{colour}" stroke="#fff" stroke-width="0.35"/>'


def cross(point: Xy, colour: str) -> str:
    """Mark the position at which the fault was injected."""
    x, y = point[0], -point[1]
    way = f"M{x - 1.3:.2f} {y - 1.3:.2f}l2.6 2.6m0 -2.6l-2.6 2.6"
    return (
        f'<path d="{way}" stroke="#fff" stroke-width="1.1"/>'
        f'<path d="{way}" stroke="{colour}" stroke-width="0.6"/>'
    )


def alarm(point: Xy) -> str:
    """Where a detector raised an alarm."""
    x, y = point[0], -point[1]
    return f'<path d="M{x:.2f} {y - 1.1:.2f}l1 1.8h-2z" fill="{ALARM}" stroke="#fff" stroke-width="0.2"/>'
