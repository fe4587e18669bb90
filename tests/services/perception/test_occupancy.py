"""The map knows what was seen, and its message says the same."""

from pathlib import Path

import numpy as np
import pyoctomap
import pytest
from numpy.typing import NDArray

from services.perception.occupancy import OccupancyMap

ORIGIN = np.array([0.0, 0.0, 3.0])
BEFORE, AT, BEHIND = (np.array([[x, 0.25, 3.25]]) for x in (5.25, 8.25, 9.25))


def wall(x: float) -> NDArray[np.float64]:
    y, z = np.meshgrid(np.arange(-2.0, 2.0, 0.2), np.arange(1.0, 5.0, 0.2))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])


def nodes(data: bytes) -> int:
    """The root and every child that is known: two bits that are not both zero."""
    return 1 + sum(byte >> shift & 3 != 0 for byte in data for shift in (0, 2, 4, 6))


def test_a_wall_is_occupied_and_what_is_before_and_behind_it_is_not() -> None:
    occupancy = OccupancyMap()
    occupancy.insert(wall(8.25), ORIGIN)
    assert occupancy.occupied(AT).all()
    assert not occupancy.occupied(BEFORE).any()
    assert not occupancy.occupied(BEHIND).any()


def test_rays_beyond_the_range_clear_space_and_mark_nothing() -> None:
    occupancy = OccupancyMap(range_m=10.0)
    occupancy.insert(wall(8.25), ORIGIN)
    for _ in range(10):
        occupancy.insert(ORIGIN + (wall(8.25) - ORIGIN) * 1.4, ORIGIN)
    assert not occupancy.occupied(wall(8.25)).any()
    assert not occupancy.occupied(ORIGIN + (wall(8.25) - ORIGIN) * 1.4).any()


def test_asking_for_the_message_does_not_change_the_map() -> None:
    # Once hit and three times missed is free (0.85 - 3 x 0.41 < 0), unless the hit was made certain.
    occupancy = OccupancyMap()
    occupancy.insert(wall(8.25), ORIGIN)
    occupancy.to_binary()
    for _ in range(3):
        occupancy.insert(ORIGIN + (wall(8.25) - ORIGIN) * 1.4, ORIGIN)
    assert not occupancy.occupied(AT).any()


def test_octomap_reads_the_message(tmp_path: Path) -> None:
    occupancy = OccupancyMap()
    occupancy.insert(wall(8.25), ORIGIN)
    occupancy.insert(wall(6.25)[::7], ORIGIN)
    data = occupancy.to_binary()
    header = f"# Octomap OcTree binary file\nid OcTree\nsize {nodes(data)}\nres 0.5\ndata\n"
    file = tmp_path / "map.bt"
    file.write_bytes(header.encode() + data)
    copy = pyoctomap.OcTree(0.5)
    assert copy.readBinary(str(file))
    grid = np.stack(np.meshgrid(*[np.arange(-1.75, 12.0, 0.5)] * 3), axis=-1).reshape(-1, 3)
    labels = copy.getLabels(grid)
    assert ((labels == 1) == occupancy.occupied(grid)).all()
    assert {-1, 0, 1} == set(labels.tolist())


def test_an_empty_map_is_an_empty_message() -> None:
    assert OccupancyMap().to_binary() == b""


@pytest.mark.parametrize("nonsense", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_no_measurement(nonsense: float) -> None:
    clean, dirty = OccupancyMap(), OccupancyMap()
    clean.insert(wall(8.25), ORIGIN)
    dirty.insert(np.vstack([wall(8.25), [[nonsense, 0.0, 3.0]], [[5.0, nonsense, 3.0]]]), ORIGIN)
    assert dirty.to_binary() == clean.to_binary()


def test_an_empty_cloud_changes_nothing() -> None:
    occupancy = OccupancyMap()
    occupancy.insert(wall(8.25), ORIGIN)
    before = occupancy.to_stream()
    occupancy.insert(np.empty((0, 3), dtype=np.float32), ORIGIN)
    assert occupancy.to_stream() == before


@pytest.mark.parametrize("absurd", [1e4, 1e9, 1e38])
def test_points_and_places_out_of_this_world_are_survived(absurd: float) -> None:
    occupancy = OccupancyMap()
    occupancy.insert(np.full((3, 3), absurd, dtype=np.float32), ORIGIN)
    occupancy.insert(wall(8.25), np.array([absurd, 0.0, 3.0]))
    occupancy.insert(wall(8.25), ORIGIN)
    assert occupancy.occupied(AT).all()
    assert not occupancy.occupied(BEHIND).any()
