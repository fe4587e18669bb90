"""Detours are cut off, legs are divided."""

import itertools

import numpy as np
import pytest

from services.planning.polyline import shorten, subdivide
from services.planning.voxels import NEAR
from tests.services.planning.maps import open_space, wall_with_ends


def test_a_detour_in_open_space_becomes_a_straight_line() -> None:
    space = open_space()
    path = np.array([[0.0, 0, 3], [5, 8, 4], [9, -3, 5], [20, 1, 2], [30, 0, 3]])
    short = shorten(path, space.levels, space.origin, space.resolution_m, NEAR)
    assert short == pytest.approx(np.array([[0.0, 0, 3], [30, 0, 3]]))


def test_a_detour_around_a_wall_is_shortened_but_stays_clear() -> None:
    walled = wall_with_ends()
    path = np.array([[0.0, 0, 3], [3, 17, 3], [28, 17, 3], [30, 0, 3]])
    short = shorten(path, walled.levels, walled.origin, walled.resolution_m, NEAR)
    assert np.linalg.norm(np.diff(short, axis=0), axis=1).sum() < 40.0
    assert all(walled.edge_clear(a, b) for a, b in itertools.pairwise(short))
    assert (short[0] == path[0]).all()
    assert (short[-1] == path[-1]).all()


def test_legs_are_divided_evenly_and_corners_kept() -> None:
    dense = subdivide(np.array([[0.0, 0, 0], [7, 0, 0], [7, 2, 0], [7, 2, 0]]), 3.0)
    assert dense == pytest.approx(
        np.array([[0.0, 0, 0], [7 / 3, 0, 0], [14 / 3, 0, 0], [7, 0, 0], [7, 2, 0], [7, 2, 0]])
    )
