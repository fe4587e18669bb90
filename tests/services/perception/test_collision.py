"""A collision ahead is found, in time, and counted once."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.perception.collision import CollisionCounter, time_to_collision
from services.perception.occupancy import OccupancyMap

SPEED = 2.0


@pytest.fixture(scope="module")
def walled() -> OccupancyMap:
    """A wall at x = 8, from y = -2 to 2, z = 1 to 5."""
    y, z = np.meshgrid(np.arange(-2.0, 2.0, 0.2), np.arange(1.0, 5.0, 0.2))
    wall = np.column_stack([np.full(y.size, 8.1), y.ravel(), z.ravel()])
    occupancy = OccupancyMap()
    occupancy.insert(wall, np.array([0.0, 0.0, 3.0]))
    return occupancy


def straight(start: tuple[float, ...], end: tuple[float, ...]) -> NDArray[np.float64]:
    """From start to end at SPEED, from t = 100 on, a point every quarter of a second."""
    a, b = np.array(start), np.array(end)
    duration = float(np.linalg.norm(b - a)) / SPEED
    rows = np.zeros((math.ceil(duration / 0.25) + 1, 12))
    rows[:, 0] = np.linspace(100.0, 100.0 + duration, len(rows))
    rows[:, 1:4] = np.linspace(a, b, len(rows))
    return rows


def test_the_body_meets_a_wall_a_radius_before_the_centre_does(walled: OccupancyMap) -> None:
    there = straight((0, 0, 3), (20, 0, 3))
    assert time_to_collision(there, 100.0, walled) == pytest.approx((8.1 - 1.5) / SPEED, abs=0.3)
    assert time_to_collision(there, 101.0, walled) == pytest.approx((8.1 - 1.5) / SPEED - 1.0, abs=0.3)


def test_a_wall_between_two_points_that_are_far_apart_is_met(walled: OccupancyMap) -> None:
    leg = straight((0, 0, 3), (20, 0, 3))[[0, -1]]
    assert time_to_collision(leg, 100.0, walled) == pytest.approx((8.1 - 1.5) / SPEED, abs=0.3)
    assert math.isinf(time_to_collision(leg, 106.5, walled))  # it is behind


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ((0, 5, 3), (20, 5, 3)),  # passes beside
        ((0, 0, 7), (20, 0, 7)),  # passes above
        ((0, 0, 3), (5, 0, 3)),  # stops before
        ((0, 40, 3), (20, 40, 3)),  # where nothing is known
    ],
)
def test_a_clear_way_is_clear(walled: OccupancyMap, start: tuple[float, ...], end: tuple[float, ...]) -> None:
    assert time_to_collision(straight(start, end), 100.0, walled) == math.inf


def test_what_lies_behind_the_vehicle_does_not_matter(walled: OccupancyMap) -> None:
    there = straight((0, 0, 3), (20, 0, 3))
    assert time_to_collision(there, 106.0, walled) == math.inf
    assert time_to_collision(there, 1000.0, walled) == math.inf


def test_a_vehicle_too_close_to_a_wall_may_leave_but_not_go_on(walled: OccupancyMap) -> None:
    assert time_to_collision(straight((7.0, 0, 3), (2, 0, 3)), 100.0, walled) == math.inf
    assert time_to_collision(straight((7.0, 0, 3), (12, 0, 3)), 100.0, walled) < 0.5


def test_without_a_trajectory_there_is_no_collision(walled: OccupancyMap) -> None:
    assert time_to_collision(np.empty((0, 12)), 100.0, walled) == math.inf


@pytest.mark.parametrize("nonsense", [math.nan, math.inf, -math.inf, 1e300, -1e18, 1e9])
@pytest.mark.parametrize("column", range(4))
def test_an_absurd_trajectory_is_survived(walled: OccupancyMap, nonsense: float, column: int) -> None:
    there = straight((0, 0, 3), (20, 0, 3))
    there[3, column] = nonsense
    assert not time_to_collision(there, 100.0, walled) < 0.0


def test_a_collision_is_counted_when_it_is_found_and_not_again() -> None:
    counter = CollisionCounter()
    verdicts = [(1, False), (1, True), (1, True), (2, True), (2, False), (2, True)]
    counts = [counter.update(seq, 0, collision=collision) for seq, collision in verdicts]
    assert counts == [0, 1, 1, 2, 2, 3]


def test_a_restarted_counter_goes_on_from_what_was_answered() -> None:
    counter = CollisionCounter()
    assert counter.update(7, 5, collision=False) == 5
    assert counter.update(7, 5, collision=True) == 6


def test_the_counter_stays_in_its_field() -> None:
    assert CollisionCounter().update(1, 2**32 - 1, collision=True) == 2**32 - 1


def test_the_body_is_as_high_as_it_is() -> None:
    """A ledge in the voxels from z = 1 to 1.5: 0.3 m of body above and below the path count."""
    y = np.arange(-2.0, 2.0, 0.2)
    ledge = OccupancyMap()
    ledge.insert(
        np.column_stack([np.full_like(y, 8.1), y, np.full_like(y, 1.25)]), np.array([0.0, 0.0, 1.25])
    )
    for z, meets in ((0.68, False), (0.72, True), (1.25, True), (1.78, True), (1.82, False)):
        found = time_to_collision(straight((0, 0, z), (20, 0, z)), 100.0, ledge)
        assert math.isfinite(found) == meets, z
