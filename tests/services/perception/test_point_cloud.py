"""Depth pixels land where the camera saw them."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.perception.point_cloud import MISS_MARGIN_M, in_world, point_cloud

WIDTH, HEIGHT, FOCAL = 8, 6, 4.0
AHEAD = np.array([1.0, 0.0, 0.0, 0.0])
HERE = np.array([10.0, 20.0, 3.0])
RANGE_M = 15.0


def cloud(depth: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    centre = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    return point_cloud(depth, FOCAL, FOCAL, *centre, RANGE_M)


def flat(depth_m: float) -> NDArray[np.float32]:
    return np.full((HEIGHT, WIDTH), depth_m, dtype=np.float32)


def test_a_wall_ahead_is_a_plane_ahead() -> None:
    points, misses = cloud(flat(4.0))
    assert len(misses) == 0
    image = points.reshape(HEIGHT, WIDTH, 3)
    assert image[..., 2] == pytest.approx(4.0)
    # Columns run from left to right, rows from top to bottom; a pixel is one metre wide at 4 m.
    assert image[0, :, 0] == pytest.approx(np.arange(WIDTH) - 3.5)
    assert image[:, 0, 1] == pytest.approx(np.arange(HEIGHT) - 2.5)
    seen = in_world(points, misses, HERE, AHEAD).reshape(HEIGHT, WIDTH, 3)
    assert seen[..., 0] == pytest.approx(14.0)
    assert seen[0, :, 1] == pytest.approx(20.0 + 3.5 - np.arange(WIDTH))
    assert seen[:, 0, 2] == pytest.approx(3.0 + 2.5 - np.arange(HEIGHT))


@pytest.mark.parametrize(
    ("axis", "angle", "direction"),
    [
        ((0.0, 0.0, 1.0), 90.0, (0.0, 1.0, 0.0)),  # yaw to the left
        ((0.0, 1.0, 0.0), 90.0, (0.0, 0.0, -1.0)),  # pitch: nose down
        ((1.0, 0.0, 0.0), 90.0, (1.0, 0.0, 0.0)),  # roll turns the image only
    ],
)
def test_the_cloud_turns_with_the_body(
    axis: tuple[float, ...], angle: float, direction: tuple[float, ...]
) -> None:
    half = math.radians(angle) / 2
    orientation = np.array([math.cos(half), *(math.sin(half) * np.array(axis))])
    middle = in_world(*cloud(flat(4.0)), HERE, orientation).mean(axis=0)
    assert middle == pytest.approx(HERE + 4.0 * np.array(direction), abs=1e-4)


@pytest.mark.parametrize("depth_m", [math.inf, 40.0])
def test_a_miss_ends_just_beyond_the_range(depth_m: float) -> None:
    points, misses = cloud(flat(depth_m))
    assert (len(points), len(misses)) == (0, WIDTH * HEIGHT)
    assert np.linalg.norm(misses, axis=1) == pytest.approx(RANGE_M + MISS_MARGIN_M, abs=1e-4)
    scan = in_world(points, misses, HERE, AHEAD)
    assert np.linalg.norm(scan - HERE, axis=1) == pytest.approx(RANGE_M + MISS_MARGIN_M, abs=1e-4)


@pytest.mark.parametrize("depth_m", [math.nan, 0.0, -3.0, -math.inf])
def test_what_is_no_measurement_gives_no_point(depth_m: float) -> None:
    depth = flat(4.0)
    depth[2, 3] = depth_m
    points, misses = cloud(depth)
    assert (len(points), len(misses)) == (WIDTH * HEIGHT - 1, 0)
    assert np.isfinite(points).all()
