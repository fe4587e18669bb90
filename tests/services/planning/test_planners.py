"""Every planner finds clear paths, the same ones for the same seed, and says so when there is none."""

import itertools
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.kernels import PLANNERS as PLANNER_NAMES
from services.planning.planners import PLANNERS, plan
from services.planning.voxels import CLOSE, NEAR, OCCUPIED, VoxelGrid
from tests.services.planning.maps import GOAL, START, box, grid, open_space, wall_with_ends

every_planner = pytest.mark.parametrize("planner", PLANNERS)


def length(path: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def assert_clear(path: NDArray[np.float64], in_grid: VoxelGrid, limit: int = NEAR) -> None:
    for a, b in itertools.pairwise(path):
        assert in_grid.edge_clear(a, b, limit)


def test_the_planners_are_those_of_the_table_of_kernels() -> None:
    assert tuple(PLANNERS) == PLANNER_NAMES


@every_planner
def test_a_path_leads_around_the_wall(planner: str) -> None:
    walled = wall_with_ends()
    for seed in range(1, 6):
        path = plan(planner, walled, START, GOAL, seed)
        assert path is not None
        assert path[0] == pytest.approx(START)
        assert path[-1] == pytest.approx(GOAL)
        assert_clear(path, walled)
        assert length(path) < 45.0


@every_planner
def test_the_same_seed_gives_the_same_path(planner: str) -> None:
    walled = wall_with_ends()
    paths = [plan(planner, walled, START, GOAL, seed) for seed in (3, 4, 3)]
    assert paths[0] is not None
    assert paths[2] is not None
    assert np.array_equal(paths[0], paths[2])
    assert paths[1] is not None
    assert not np.array_equal(paths[0], paths[1])


@every_planner
def test_in_open_space_the_path_is_straight(planner: str) -> None:
    path = plan(planner, open_space(), START, GOAL, 1)
    assert path is not None
    assert length(path) == pytest.approx(30.0, rel=0.01)


@every_planner
def test_there_is_no_path_out_of_a_closed_room(planner: str) -> None:
    room = box((-6.0, -6.0, 0.0), (6.0, 6.0, 11.0))
    room = room[(np.abs(room[:, :2]) > 5.0).any(axis=1)]
    assert plan(planner, grid(room), START, GOAL, 1) is None


@every_planner
def test_the_budget_is_counted_in_iterations(planner: str) -> None:
    assert plan(planner, wall_with_ends(), START, GOAL, 1, iterations=2) is None


@every_planner
def test_a_start_too_close_to_a_wall_is_left(planner: str) -> None:
    walled = wall_with_ends()
    for gap in (1.8, 1.0, 0.3, -0.2):
        start = np.array([14.0 - gap, 0.0, 3.0])
        path = plan(planner, walled, start, GOAL, 1)
        assert path is not None
        assert path[0] == pytest.approx(start)
        assert path[1][0] < 12.0
        assert_clear(path[1:], walled)


@every_planner
def test_a_start_on_the_ground_is_left_upwards(planner: str) -> None:
    start = np.array([0.0, 0.0, 0.1])
    path = plan(planner, open_space(), start, GOAL, 1)
    assert path is not None
    assert path[0] == pytest.approx(start)
    assert path[1] == pytest.approx([0.0, 0.0, 1.25], abs=0.5)


@every_planner
def test_a_blocked_goal_is_approached(planner: str) -> None:
    walled = wall_with_ends()
    path = plan(planner, walled, START, np.array([13.0, 0.0, 3.0]), 1)
    assert path is not None
    assert np.linalg.norm(path[-1] - [13.0, 0.0, 3.0]) < 3.0
    assert_clear(path, walled)


@every_planner
@pytest.mark.parametrize("gap_m", [0.0, 1e-15, 1e-9, 1e-3])
def test_where_the_goal_is_already_there_is_nothing_to_search(planner: str, gap_m: float) -> None:
    goal = GOAL + np.array([gap_m, 0.0, 0.0])
    path = plan(planner, open_space(), GOAL, goal, 1)
    assert path is not None
    assert path[-1] == pytest.approx(goal)
    assert length(path) == pytest.approx(gap_m, rel=0.02, abs=1e-12)


def test_no_place_near_the_goal_no_path() -> None:
    block = grid(box((20.0, -10.0, 0.0), (40.0, 10.0, 11.0)))
    assert plan("rrt_connect", block, START, GOAL, 1) is None


def test_with_less_clearance_a_gap_is_passed() -> None:
    wall = box((14.0, -20.0, 0.0), (15.0, 20.0, 11.0))
    wall = wall[np.abs(wall[:, 1]) > 2.0]
    gap = grid(wall, box((5.0, -20.0, 0.0), (25.0, 20.0, 11.0)))
    assert plan("rrt_connect", gap, START, GOAL, 1) is None
    path = plan("rrt_connect", gap, START, GOAL, 1, limit=CLOSE)
    assert path is not None
    assert_clear(path, gap, CLOSE)


def test_rrt_star_is_worth_its_name() -> None:
    """Among pillars its paths are shorter than those of RRT, which stops at the first."""
    draw = np.random.default_rng(5)
    pillars = [
        box((x, y, 0.0), (x + 2.0, y + 2.0, 11.0)) for x, y in draw.uniform((4, -18), (26, 16), (14, 2))
    ]
    forest = grid(np.vstack(pillars), box((-10.0, -20.0, 0.0), (40.0, 20.0, 11.0))[::2])
    mean = {}
    for planner in ("rrt", "rrt_star"):
        paths = [plan(planner, forest, START, GOAL, seed) for seed in range(1, 9)]
        mean[planner] = np.mean([length(path) for path in paths if path is not None])
    assert mean["rrt_star"] < mean["rrt"]


def test_prm_star_repeats_under_load_and_starts_no_thread() -> None:
    """OMPL's own way to ask a roadmap looks for solutions in a second thread."""
    walled, threads = wall_with_ends(), set(Path("/proc/self/task").iterdir())
    calm = plan("prm_star", walled, START, GOAL, 5)
    # Before those that make the load: one that has ended is listed a little longer.
    assert set(Path("/proc/self/task").iterdir()) <= threads
    with ThreadPoolExecutor(2) as pool:
        load = [pool.submit(sum, range(20_000_000)) for _ in range(2)]
        loaded = plan("prm_star", walled, START, GOAL, 5)
        for one in load:
            one.result()
    assert calm is not None
    assert loaded is not None
    assert np.array_equal(calm, loaded)


def test_more_samples_make_a_roadmap_no_worse() -> None:
    walled = wall_with_ends()
    means = []
    for samples in (150, 900):
        paths = [plan("prm_star", walled, START, GOAL, seed, iterations=samples) for seed in range(1, 9)]
        means.append(np.mean([length(path) for path in paths if path is not None]))
    assert means[1] < means[0]


def test_nothing_leads_through_what_is_occupied() -> None:
    walled = wall_with_ends()
    behind = plan("rrt_connect", walled, np.array([13.6, 0.0, 3.0]), GOAL, 2)
    assert behind is not None
    assert walled.edge_clear(behind[0], behind[1], OCCUPIED)


@pytest.mark.parametrize(
    ("planner", "corners", "lengths_m"),
    [
        ("rrt", (3, 3), (35.484221, 35.426146)),
        ("rrt_connect", (3, 4), (35.693074, 36.230115)),
        ("rrt_star", (4, 4), (34.64881, 34.722643)),
        ("prm_star", (3, 5), (35.565664, 34.583961)),
    ],
)
def test_paths_are_those_of_the_releases_before(
    planner: str, corners: tuple[int, ...], lengths_m: tuple[float, ...]
) -> None:
    """Digests of flights hang on them: a change is told in the changelog."""
    paths = [plan(planner, wall_with_ends(), START, GOAL, seed) for seed in (1, 2)]
    found = [path for path in paths if path is not None]
    assert tuple(len(path) for path in found) == corners
    assert [length(path) for path in found] == pytest.approx(list(lengths_m), abs=1e-5)
