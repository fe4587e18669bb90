from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from services.models.safety import BODY_RADIUS_M
from services.models.world import BoxWorld, WorldDefinition
from sim.moving import swept
from sim.world import (
    DEFINITION,
    KEEP_OUT_M,
    BadWorldError,
    World,
    definition,
    make_world,
    world_names,
)

SEEDS = range(200)
CELL_M = 10.0


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
        assert distances(world, line).min() <= BODY_RADIUS_M + 0.1


def test_nobody_changes_a_world(worlds: list[World]) -> None:
    with pytest.raises(ValueError, match="read-only"):
        worlds[0].obstacles[0, 0] = 0.0


def test_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(BadWorldError, match=r"'sprase'; known: .*sparse"):
        make_world("sprase", 0)


def test_every_world_that_comes_along_has_its_ends_free_and_something_in_the_way() -> None:
    assert {"sparse", "dense", "factory", "farm"} <= set(world_names())
    for name in world_names():
        for seed in range(5):
            world = make_world(name, seed)
            assert distances(world, np.stack([world.start, world.goal])).min() >= BODY_RADIUS_M
            line = world.start + np.linspace(0.0, 1.0, 501)[:, None] * (world.goal - world.start)
            everywhere = replace(world, obstacles=np.vstack([world.obstacles, swept(world.moving)]))
            assert distances(everywhere, line).min() <= BODY_RADIUS_M + 0.1


@pytest.mark.parametrize(
    ("name", "density", "size"),
    [
        ("train-0.05-3", 0.05, 3.0),
        ("train-0.05-5", 0.05, 5.0),
        ("train-0.2-3", 0.2, 3.0),
        ("train-0.2-5", 0.2, 5.0),
    ],
)
def test_the_training_configurations_are_the_papers(name: str, density: float, size: float) -> None:
    worlds = [make_world(name, seed) for seed in range(100)]
    assert {content(world) for world in worlds}.isdisjoint({content(make_world("sparse", 0))})
    sides = np.concatenate([world.obstacles[:, 3:5] - world.obstacles[:, :2] for world in worlds])
    assert sides == pytest.approx(size)
    assert np.mean([len(world.obstacles) for world in worlds]) == pytest.approx(100 * density, rel=0.25)


def test_clusters_are_dense_at_their_centroids_and_keep_their_gaps() -> None:
    wanted = DEFINITION.validate_python(
        {
            "name": "yard",
            "kind": "clustered",
            "centroids": [[-10.0, 5.0], [12.0, 2.0]],
            "spread_m": 6.0,
            "density": 0.9,
            "obstacle_m": 1.5,
            "gap_m": 2.0,
        }
    )
    near = far = 0
    for seed in range(30):
        boxes = make_world(wanted, seed).obstacles
        middle = (boxes[:, :2] + boxes[:, 3:5]) / 2
        off = np.linalg.norm(middle[:, None] - np.array([[-10.0, 5.0], [12.0, 2.0]]), axis=2).min(axis=1)
        near, far = near + int((off < 6).sum()), far + int((off > 18).sum())
        lo, hi = boxes[:, None, :2], boxes[None, :, 3:5]
        apart = np.maximum(lo - hi, boxes[None, :, :2] - boxes[:, None, 3:5]).max(axis=2)
        assert (apart[~np.eye(len(boxes), dtype=bool)] >= 2.0 - 1e-9).all()
    assert near > 20 * far > 0 or far == 0


GRID = {"name": "mine", "kind": "grid", "density": 0.2, "obstacle_m": 5.0}
BOXES = {"name": "mine", "kind": "boxes", "boxes": [[0.0, 0.0, 0.0, 3.0, 3.0, 9.0]]}


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        (GRID | {"density": 0.0}, "density 0"),
        (GRID | {"density": 1e-7}, "density 1e-07"),
        (GRID | {"obstacle_m": 11.0}, "obstacle_m 11 does not fit"),
        (GRID | {"cell_m": 200.0, "obstacle_m": 5.0}, "cell of 200 m"),
        (GRID | {"start": [-51.0, 0.0, 2.0]}, r"start \[-51, 0, 2\]"),
        (GRID | {"goal": [0.0, 0.0, 12.0]}, r"goal \[0, 0, 12\]"),
        (GRID | {"lower": [60.0, -50.0, 0.0]}, "lower x 60"),
        (BOXES | {"boxes": []}, "without obstacles"),
        (BOXES | {"start": [1.0, 2.0, 2.0]}, r"start \[1, 2, 2\] is inside boxes.0"),
        (BOXES | {"goal": [1.0, 2.0, 2.0]}, r"goal \[1, 2, 2\] is inside boxes.0"),
        (BOXES | {"boxes": [[0.0, 0.0, 0.0, -3.0, 3.0, 9.0]]}, "boxes.0"),
    ],
)
def test_what_makes_no_world_is_refused_with_its_value(fields: dict[str, object], says: str) -> None:
    with pytest.raises(BadWorldError, match=says):
        make_world(DEFINITION.validate_python(fields), 0)


@pytest.mark.parametrize("density", [-0.1, 1.1, float("nan")])
def test_a_density_that_is_no_probability_is_refused(density: float) -> None:
    with pytest.raises(ValidationError, match="density"):
        DEFINITION.validate_python(GRID | {"density": density})


def test_a_world_made_by_hand_is_the_same_for_every_seed() -> None:
    assert isinstance(definition("factory"), BoxWorld)
    assert content(make_world("factory", 1)) == content(make_world("factory", 2))


def wide(**fields: object) -> WorldDefinition:
    return DEFINITION.validate_python(
        {"name": "w", "lower": (-200, -200, 0), "upper": (200, 200, 10), **fields}
    )


@pytest.mark.parametrize(
    "wanted",
    [
        wide(kind="grid", density=0.5, obstacle_m=0.1, cell_m=0.1),
        wide(kind="clustered", centroids=[(0, 0)] * 100, density=0.5, spread_m=5, obstacle_m=1, gap_m=1),
        wide(kind="forest", stems_per_ha=10_000),
    ],
    ids=lambda wanted: wanted.kind,
)
def test_a_world_too_large_to_draw_is_refused_before_it_is_drawn(wanted: WorldDefinition) -> None:
    with pytest.raises(BadWorldError, match="places for obstacles, at most 100000 are allowed: make"):
        make_world(wanted, 0)


def test_a_large_world_is_drawn_less_often_until_it_is_given_up() -> None:
    with pytest.raises(BadWorldError, match="none of 50 draws puts an obstacle"):
        make_world(wide(kind="grid", density=1e-9, obstacle_m=0.5, cell_m=2.0), 0)
