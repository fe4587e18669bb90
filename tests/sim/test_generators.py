"""Graded worlds: what their difficulty changes, what stays free, and that a seed means a world."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from services.models.safety import BODY_RADIUS_M
from services.models.world import ForestWorld, GatesWorld, TrafficWorld
from sim.generators import BRANCH_M, forest_figures
from sim.mission.coverage import survey
from sim.moving import swept
from sim.world import DEFINITION, KEEP_OUT_M, BadWorldError, World, make_world, meets

KINDS = ("forest", "gates", "traffic")


def graded(kind: str, difficulty: float, seed: int, **fields: object) -> World:
    stated = {"name": kind, "kind": kind, "difficulty": difficulty, **fields}
    return make_world(DEFINITION.validate_python(stated), seed)


def content(world: World) -> bytes:
    return world.obstacles.tobytes() + world.moving.tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_is_a_world(kind: str) -> None:
    drawn = [content(make_world(kind, seed)) for seed in range(20)]
    assert drawn == [content(make_world(kind, seed)) for seed in range(20)]
    assert len(set(drawn)) == 20


def test_a_stored_specification_still_means_the_world_that_it_meant() -> None:
    drawn = b"".join(content(graded(kind, 0.5, seed)) for kind in KINDS for seed in range(10))
    digest = hashlib.sha256(drawn).hexdigest()
    assert digest == "5f38ad4a5d934e22161fa88ba523775f7502bb5e88b044d7dabe7bd00d4012e1"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("difficulty", [0.0, 1.0])
def test_start_and_goal_stay_free_at_all_times_and_something_is_in_the_way(
    kind: str, difficulty: float
) -> None:
    for seed in range(10):
        world = graded(kind, difficulty, seed)
        always = np.vstack([world.fixed, swept(world.moving)])
        for end in (world.start, world.goal):
            assert not meets(always, end, end, KEEP_OUT_M).any()
        assert meets(always, world.start, world.goal, BODY_RADIUS_M).any()


def test_a_harder_forest_has_more_and_thinner_trees() -> None:
    easy, hard = (graded("forest", difficulty, 4) for difficulty in (0.0, 1.0))

    def trunks(world: World) -> np.ndarray:
        return np.asarray(world.obstacles[world.obstacles[:, 5] >= 20.0])

    assert len(trunks(hard)) > 2 * len(trunks(easy))
    sides = [np.ptp(trunks(world).reshape(-1, 2, 3)[:, :, :2], axis=1).mean() for world in (easy, hard)]
    assert sides[1] < sides[0] / 3


def test_trees_keep_their_gap_and_branches_are_level_and_thin() -> None:
    figures = forest_figures(ForestWorld(name="forest", kind="forest", difficulty=1.0))
    boxes = graded("forest", 1.0, 3).obstacles
    trunks, branches = boxes[boxes[:, 5] >= 20.0], boxes[boxes[:, 5] < 20.0]
    middle = (trunks[:, :2] + trunks[:, 3:5]) / 2
    apart = np.linalg.norm(middle[:, None] - middle, axis=2)[~np.eye(len(middle), dtype=bool)]
    assert apart.min() >= figures.gap_m - 1e-9
    size = np.sort(branches[:, 3:] - branches[:, :3], axis=1)
    assert size[:, :2] == pytest.approx(figures.trunk_m / 2)
    assert (size[:, 2] >= BRANCH_M[0]).all()
    assert branches[:, 5] - branches[:, 2] == pytest.approx(figures.trunk_m / 2)
    assert len(branches) == pytest.approx(figures.branches * len(trunks), rel=0.4)


@pytest.mark.parametrize("clearance_m", [0.5, 2.0])
def test_a_gate_is_as_much_wider_than_the_body_as_was_asked_for(clearance_m: float) -> None:
    for seed in range(5):
        world = graded("gates", 0.5, seed, clearance_m=clearance_m, walls=3)
        across = world.obstacles[np.ptp(world.obstacles[:, [0, 3]], axis=1) < 1.0][2:]
        assert len({float(box[0]) for box in across}) == 3
        # The widest way leads through the middles of gates; there is no other.
        assert survey(world).widest_way_m == pytest.approx(BODY_RADIUS_M + clearance_m, abs=0.3)


def test_traffic_crosses_the_way_no_faster_than_asked_for() -> None:
    world = graded("traffic", 0.5, 1, speed_m_s=1.5, movers=6)
    assert len(world.moving) == 6
    speeds = 2 * np.linalg.norm(world.moving[:, 6:9], axis=1) / world.moving[:, 9]
    assert (speeds <= 1.5 + 1e-9).all()
    assert (speeds >= 0.7 * 1.5 - 1e-9).all()
    assert (abs(world.moving[:, 7]) > abs(world.moving[:, 6])).all()


def test_given_parameters_go_before_the_difficultys() -> None:
    assert len(graded("traffic", 0.0, 1, movers=9).moving) == 9
    assert content(graded("forest", 0.3, 1, trunk_m=0.2)) != content(graded("forest", 0.3, 1))


def test_a_forest_that_is_never_in_the_way_is_refused_with_its_figures() -> None:
    with pytest.raises(BadWorldError, match=r"stems_per_ha 0\.01: none of 1000 draws"):
        graded("forest", 0.0, 0, stems_per_ha=0.01)


@pytest.mark.parametrize("kind", [ForestWorld, GatesWorld, TrafficWorld])
@pytest.mark.parametrize("difficulty", [-0.1, 1.1, float("nan")])
def test_a_difficulty_outside_0_to_1_is_refused(kind: type, difficulty: float) -> None:
    with pytest.raises(ValueError, match="difficulty"):
        kind(name="x", kind=kind.__name__.removesuffix("World").lower(), difficulty=difficulty)
