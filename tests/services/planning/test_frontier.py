"""Exploration goes where the most is unknown, by ways that were seen, and ends."""

import numpy as np
import pytest
from numpy.typing import NDArray

from services.bus.octomaps import UNKNOWN, known
from services.planning.frontier import NEAREST_M, frontier
from services.planning.voxels import unpack
from tests.services.planning.maps import HIGH, LOW, RESOLUTION_M, box, payload, tree

LOWER, UPPER = np.array([-8.0, -12.0, 3.0]), np.array([32.0, 12.0, 3.0])
HERE = np.array([0.0, 0.0, 3.0])
NONE = np.empty((0, 3))


def seen(*free: tuple[float, float, float, float], occupied: NDArray[np.float64] = NONE) -> bytes:
    """A map that knows the rectangles (x, y, x, y) at flight height to be free."""
    rooms = [box((x, y, 2.0), (xx, yy, 4.0)) for x, y, xx, yy in free]
    return payload(tree(occupied, np.vstack(rooms)))


def ask(
    octomap: bytes, position: NDArray[np.float64] = HERE, tried: NDArray[np.float64] = NONE
) -> NDArray[np.float64]:
    grid = unpack(octomap, RESOLUTION_M, LOW, HIGH)
    voxels = known(octomap, RESOLUTION_M, LOW, HIGH)
    return frontier(grid.levels, voxels, grid.origin, RESOLUTION_M, LOWER, UPPER, position, tried)


def test_the_goal_lies_at_the_edge_of_what_was_seen() -> None:
    octomap = seen((-8.0, -12.0, 10.0, 12.0))
    goal = ask(octomap)
    assert goal[0] == pytest.approx(9.75)
    assert goal[2] == 3.0
    cells = known(octomap, RESOLUTION_M, LOW, HIGH)
    i, j, k = np.floor((goal - LOW) / RESOLUTION_M).astype(int)
    assert cells[i, j, k] != UNKNOWN
    assert cells[i + 1, j, k] == UNKNOWN


def test_when_all_of_the_area_was_seen_there_is_no_goal() -> None:
    assert len(ask(seen((-9.0, -13.0, 33.0, 13.0)))) == 0


def test_what_lies_outside_the_area_is_no_gain() -> None:
    assert len(ask(seen((-8.0, -12.0, 32.0, 12.0)))) == 0


def test_before_anything_was_seen_there_is_no_goal() -> None:
    assert len(ask(b"")) == 0


def test_a_frontier_that_cannot_be_reached_is_no_goal() -> None:
    assert ask(seen((-8.0, -12.0, 4.0, 12.0), (10.0, -12.0, 20.0, 12.0)))[0] < 5.0
    wall = box((10.0, -12.5, 2.0), (10.5, 12.5, 4.0))
    walled = seen((-8.0, -12.0, 10.0, 12.0), (10.5, -12.0, 20.0, 12.0), occupied=wall)
    assert len(ask(walled)) == 0
    assert ask(walled, np.array([15.0, 0.0, 3.0]))[0] > 18.0


def test_goals_keep_clear_of_obstacles_and_of_the_vehicle() -> None:
    pillar = box((9.0, -1.0, 2.0), (10.0, 1.0, 4.0))
    octomap = seen((-8.0, -12.0, 10.0, 12.0), occupied=pillar)
    grid = unpack(octomap, RESOLUTION_M, LOW, HIGH)
    goal = ask(octomap, np.array([6.0, 6.0, 3.0]))
    assert grid.level(goal) == 0
    assert np.linalg.norm(goal - [6.0, 6.0, 3.0]) >= NEAREST_M


def test_a_place_is_tried_once_and_places_are_soon_exhausted() -> None:
    octomap, tried = seen((-8.0, -12.0, 10.0, 12.0)), NONE
    for _ in range(40):
        goal = ask(octomap, tried=tried)
        if not len(goal):
            break
        assert (np.linalg.norm(tried - goal, axis=1) > 1.0).all()
        tried = np.vstack([tried, goal])
    assert 5 < len(tried) < 40


def test_the_same_map_gives_the_same_goal() -> None:
    octomap = seen((-8.0, -12.0, 10.0, 12.0))
    assert np.array_equal(ask(octomap), ask(octomap))
