"""Plan view of a world, as SVG or PNG: north up, lighter obstacles are lower.

Two shapes are enough, and both formats draw the same list of them. PNG is written by hand (a header, one
compressed block of pixels): a drawing library would be the largest dependency for the smallest use.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.models.safety import BODY_RADIUS_M
from sim.world import World

PIXELS_PER_M = 8
MARGIN_M = 2.0
CELL_M = 10.0

_PAPER, _GRID, _GROUND = 0xFFFFFF, 0xE4E8EC, 0xF7F8F9
_START, _GOAL, _HALO = 0x2E8B57, 0xC0392B, 0xD9E4F0
_MOVING = 0xC26A1B

THINNEST_M = 0.25
"""Thinner obstacles are drawn this thick, or they would not be seen."""


@dataclass(frozen=True, slots=True)
class Rectangle:
    """From (x0, y0) to (x1, y1), m."""

    x0: float
    y0: float
    x1: float
    y1: float
    colour: int


@dataclass(frozen=True, slots=True)
class Disc:
    """A disc around (x, y), in metres."""

    x: float
    y: float
    radius: float
    colour: int


Shape = Rectangle | Disc


def shapes(world: World, time_s: float | None = 0.0) -> list[Shape]:
    """What a plan shows at a virtual time, from the ground up; None leaves out what moves, not its ways."""
    (left, south), (right, north) = world.bounds[:, :2].tolist()
    drawn: list[Shape] = [Rectangle(left, south, right, north, _GROUND)]
    drawn += [
        Rectangle(x - 0.1, south, x + 0.1, north, _GRID)
        for x in np.arange(left, right + 0.1, CELL_M).tolist()
    ]
    drawn += [
        Rectangle(left, y - 0.1, right, y + 0.1, _GRID)
        for y in np.arange(south, north + 0.1, CELL_M).tolist()
    ]
    ends = ((world.start, _START), (world.goal, _GOAL))
    drawn += [Disc(float(end[0]), float(end[1]), BODY_RADIUS_M, _HALO) for end, _ in ends]
    ceiling = float(world.bounds[1, 2])
    drawn += [_seen(box, _shade(box[5] / ceiling)) for box in world.fixed.tolist()]
    drawn += [dot for row in world.moving.tolist() for dot in _way(row)]
    if time_s is not None:
        drawn += moving_shapes(world, time_s)
    drawn += [Disc(float(end[0]), float(end[1]), 0.8, colour) for end, colour in ends]
    return drawn


def moving_shapes(world: World, time_s: float) -> list[Shape]:
    """The moving obstacles at a virtual time."""
    return [_seen(box, _MOVING) for box in world.moved(time_s).tolist()]


def _seen(box: Sequence[float], colour: int) -> Rectangle:
    x0, y0, _, x1, y1, _ = box
    wider, higher = (max(THINNEST_M - size, 0.0) / 2 for size in (x1 - x0, y1 - y0))
    return Rectangle(x0 - wider, y0 - higher, x1 + wider, y1 + higher, colour)


def _way(row: Sequence[float]) -> Iterator[Disc]:
    """Dots along the way of a moving obstacle, a metre apart."""
    x, y = (row[0] + row[3]) / 2, (row[1] + row[4]) / 2
    count = int(np.hypot(row[6], row[7])) + 2
    for part in np.linspace(0.0, 1.0, count).tolist():
        yield Disc(x + part * row[6], y + part * row[7], 0.15, _MOVING)


def _shade(height: float) -> int:
    """Grey of an obstacle, darkest where it reaches the flight ceiling."""
    level = round(0xB8 - (0xB8 - 0x3C) * min(max(height, 0.0), 1.0))
    return level << 16 | (level + 6) << 8 | (level + 12)


def view_box(world: World) -> tuple[float, float, float, float]:
    """Left, top, width and height of the plan in its SVG, m; y grows downwards there."""
    (left, south), (right, north) = world.bounds[:, :2].tolist()
    return left - MARGIN_M, -north - MARGIN_M, right - left + 2 * MARGIN_M, north - south + 2 * MARGIN_M


def svg(world: World) -> str:
    """The plan as an SVG document, metres as user units."""
    left, top, width, height = view_box(world)
    view = f"{left:g} {top:g} {width:g} {height:g}"
    size = f'width="{width * PIXELS_PER_M:g}" height="{height * PIXELS_PER_M:g}"'
    opening = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{view}" {size}>'
    title = f"<title>{world.name}, seed {world.seed}</title>"
    return "\n".join([opening, title, *svg_elements(shapes(world)), "</svg>", ""])


def svg_elements(drawn: Sequence[Shape]) -> list[str]:
    """Shapes as SVG elements, from the ground up."""
    lines = []
    for shape in drawn:
        fill = f'fill="#{shape.colour:06x}"'
        if isinstance(shape, Rectangle):
            size = f'width="{shape.x1 - shape.x0:.3f}" height="{shape.y1 - shape.y0:.3f}"'
            lines.append(f'<rect x="{shape.x0:.3f}" y="{-shape.y1:.3f}" {size} {fill}/>')
        else:
            lines.append(f'<circle cx="{shape.x:.3f}" cy="{-shape.y:.3f}" r="{shape.radius:g}" {fill}/>')
    return lines


def png(world: World) -> bytes:
    """Render the plan as a PNG file."""
    (left, south), (right, north) = world.bounds[:, :2]
    width = round((right - left + 2 * MARGIN_M) * PIXELS_PER_M)
    height = round((north - south + 2 * MARGIN_M) * PIXELS_PER_M)
    x = left - MARGIN_M + (np.arange(width) + 0.5) / PIXELS_PER_M
    y = (north + MARGIN_M - (np.arange(height) + 0.5) / PIXELS_PER_M)[:, None]
    image = np.full((height, width), _PAPER, dtype=np.uint32)
    for shape in shapes(world):
        if isinstance(shape, Rectangle):
            inside = (x >= shape.x0) & (x < shape.x1) & (y >= shape.y0) & (y < shape.y1)
        else:
            inside = (x - shape.x) ** 2 + (y - shape.y) ** 2 <= shape.radius**2
        image[inside] = shape.colour
    rgb = np.stack([image >> 16, image >> 8, image], axis=-1).astype(np.uint8)
    return encode_png(rgb)


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """``image`` (height, width, 3 or 4), RGB or with opacity, as a PNG file."""
    height, width, channels = image.shape
    # Each row begins with its filter: none.
    rows = np.hstack([np.zeros((height, 1), np.uint8), image.reshape(height, -1)]).tobytes()
    header = struct.pack(">IIBBBBB", width, height, 8, 2 if channels == 3 else 6, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows, 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
