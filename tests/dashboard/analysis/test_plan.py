"""Plans of worlds: thin obstacles are seen, moving ones are where they are."""

import zlib

import numpy as np

from dashboard.analysis.plan import THINNEST_M, Disc, Rectangle, moving_shapes, png, shapes
from sim.world import make_world


def test_thin_obstacles_are_thick_enough_to_be_seen() -> None:
    world = make_world("forest", 4)
    boxes = [one for one in shapes(world) if isinstance(one, Rectangle)][-len(world.obstacles) :]
    sizes = np.array([(one.x1 - one.x0, one.y1 - one.y0) for one in boxes])
    assert sizes.min() >= THINNEST_M - 1e-9
    middles = np.array([((one.x0 + one.x1) / 2, (one.y0 + one.y1) / 2) for one in boxes])
    assert np.allclose(middles, (world.obstacles[:, :2] + world.obstacles[:, 3:5]) / 2)
    assert zlib.decompress(png(world).split(b"IDAT")[1].split(b"IEND")[0][:-8])


def test_moving_obstacles_are_drawn_at_their_moment_on_their_ways() -> None:
    world = make_world("traffic", 3)
    early, late = (
        [one for one in moving_shapes(world, time_s) if isinstance(one, Rectangle)] for time_s in (0.0, 9.0)
    )
    assert len(early) == len(world.moving)
    assert [(one.x0, one.y0) for one in late] == [(box[0], box[1]) for box in world.moved(9.0)]
    assert [(one.x0, one.y0) for one in late] != [(one.x0, one.y0) for one in early]
    without = shapes(world, None)
    assert not set(early) & set(without)
    dots = np.array([(one.x, one.y) for one in without if isinstance(one, Disc) and one.radius < 0.3])
    for one in late:
        centre = np.array([(one.x0 + one.x1) / 2, (one.y0 + one.y1) / 2])
        assert np.linalg.norm(dots - centre, axis=1).min() < 0.6
