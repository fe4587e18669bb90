from __future__ import annotations

import hashlib

import numpy as np
import pytest

from sim.world import CELL_M, KEEP_OUT_M, SAFETY_RADIUS_M, UnknownWorldError, World, make_world

SEEDS = range(200)


@pytest.fixture(scope="module")
def worlds() -> list[World]:
    return [make_world("sparse", seed) for seed in SEEDS]


def distances(world: World, points: np.ndarray) -> np.ndarray:
    """From each point (m, 3) to each obstacle, (m, n)."""
    lo, hi = world.obstacles[:, :3], world.obstacles[:, 3:]
    nearest = np.clip(points[:, None, :], lo, hi)
    return np.asarray(np.linalg.norm(points[:, None, :] - nearest, axis=2))


def content(world: World) -> bytes:
    return b"".join(array.tobytes() for array in (world.bounds, world.obstacles, world.start, world.goal))


def test_same_seed_gives_the_same_bytes_and_another_seed_other_ones(worlds: list[World]) -> None:
    assert [content(make_world("sparse", seed)) for seed in SEEDS] == [content(world) for world in worlds]
    assert len({content(world) for world in worlds}) == len(worlds)


def test_a_stored_specification_still_means_the_world_that_it_meant(worlds: list[World]) -> None:
    digest = hashlib.sha256(b"".join(map(content, worlds))).hexdigest()
    assert digest == "ca804fdc6207d6c209cd4ca72750aeeec0272bedc5db483caedd973b1d33529c"


def test_start_and_goal_are_free_inside_the_bounds_and_fifty_metres_apart(worlds: list[World]) -> None:
    for world in worlds:
        ends = np.stack([world.start, world.goal])
        assert distances(world, ends).min() >= KEEP_OUT_M
        assert (world.bounds[0] < ends).all()
        assert (ends < world.bounds[1]).all()
        assert np.linalg.norm(world.goal - world.start) == pytest.approx(50.0)


def test_obstacles_are_the_papers(worlds: list[World]) -> None:
    for world in worlds:
        lo, hi = world.obstacles[:, :3], world.obstacles[:, 3:]
        assert hi[:, :2] - lo[:, :2] == pytest.approx(3.0)
        assert (lo[:, 2] == 0.0).all()
        assert (hi[:, 2] >= 2 * world.bounds[1, 2]).all()
        cells = np.floor(lo[:, :2] / CELL_M)
        assert (np.ceil(hi[:, :2] / CELL_M) - cells <= 1 + 1e-9).all()
        assert len(np.unique(cells, axis=0)) == len(cells)
    # One cell in twenty of a hundred; that one stands in the way raises the mean by about one.
    assert 4.5 < np.mean([len(world.obstacles) for world in worlds]) < 7.0


def test_something_always_stands_in_the_straight_way(worlds: list[World]) -> None:
    for world in worlds:
        line = world.start + np.linspace(0.0, 1.0, 501)[:, None] * (world.goal - world.start)
        assert distances(world, line).min() <= SAFETY_RADIUS_M + 0.1


def test_nobody_changes_a_world(worlds: list[World]) -> None:
    with pytest.raises(ValueError, match="read-only"):
        worlds[0].obstacles[0, 0] = 0.0


def test_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownWorldError, match=r"'sprase'; known: .*sparse"):
        make_world("sprase", 0)
