"""Areas: where they lie by default, what is refused, what counts as covered and as seen."""

from __future__ import annotations

import numpy as np
import pytest

from deploy.config.check import check
from deploy.errors import BadSpecError
from services.models.equipment import Camera
from services.models.mission import Area, MissionSpec
from sim.mission.area import CameraView, cells, corners, mark_overflown
from sim.vehicle.airframe import airframe
from sim.vehicle.vehicle import Vehicle
from sim.world import make_world, world_names
from tests.sim.worlds import world_with


@pytest.mark.parametrize("name", world_names())
def test_the_default_area_holds_start_and_goal_and_is_of_moderate_size(name: str) -> None:
    world = make_world(name, 1)
    lower, upper = corners(Area(), world)
    for place in (world.start, world.goal):
        assert (lower[:2] <= place[:2]).all()
        assert (place[:2] <= upper[:2]).all()
    assert (upper - lower)[:2].min() >= 24.0
    assert (upper - lower)[:2].prod() < 2000.0
    assert lower[2] == upper[2] == world.start[2]


@pytest.mark.parametrize(
    "area",
    [
        {"lower": (10.0, 0.0), "upper": (-10.0, 5.0)},
        {"upper": (500.0, 5.0)},
        {"lower": (float("-1e9"), 0.0)},
    ],
)
def test_an_area_that_is_none_is_refused_in_one_line(area: dict[str, object]) -> None:
    spec = MissionSpec.model_validate({"mission": "scanning", "area": area})
    with pytest.raises(BadSpecError, match="area: lower") as refused:
        check(spec)
    assert "\n" not in str(refused.value)


def test_cells_inside_obstacles_do_not_count() -> None:
    area = np.array([[0.0, 0.0, 2.0], [10.0, 8.0, 2.0]])
    boxes = np.array([[2.0, 2.0, 0.0, 5.0, 4.0, 20.0], [7.0, 7.0, 0.0, 9.0, 9.0, 1.0]])
    assert len(cells(area, boxes[:0])) == 80
    assert len(cells(area, boxes)) == 80 - 6


def test_overflown_is_what_lies_within_half_a_swath() -> None:
    places = np.array([[0.0, 3.9, 2.0], [0.0, 4.1, 2.0], [2.0, 2.0, 9.0]])
    covered = np.zeros(3, dtype=np.bool_)
    mark_overflown(places, covered, np.array([0.0, 0.0, 2.0]), 4.0)
    assert covered.tolist() == [True, False, True]


def test_seen_is_what_the_camera_has_in_view_and_nothing_hides() -> None:
    world = world_with()
    vehicle = Vehicle(world, airframe("airsim"))
    eye = vehicle.position
    offsets = {
        "ahead": (3.0, 0.0, 0.0),
        "far": (10.5, 5.0, 0.0),
        "behind": (-3.0, 0.0, 0.0),
        "left": (3.0, 2.9, 0.0),
        "too far left": (3.0, 3.1, 0.0),
        "too low": (1.0, 0.0, -0.7),
    }
    assert vehicle.yaw == 0.0
    places = np.array([eye + np.array(offset) for offset in offsets.values()])
    seen = np.zeros(len(places), dtype=np.bool_)
    CameraView(Camera(), 10.0, world.obstacles).mark(vehicle, places, seen)
    assert dict(zip(offsets, seen.tolist(), strict=True)) == {
        "ahead": True,
        "far": False,
        "behind": False,
        "left": True,
        "too far left": False,
        "too low": False,
    }


def test_what_stands_behind_an_obstacle_is_not_seen() -> None:
    start = Vehicle(world_with(), airframe("airsim")).position
    box = (start[0] + 3.0, start[1] - 1.0, 0.0, start[0] + 4.0, start[1] + 1.0, 20.0)
    vehicle = Vehicle(world_with(box), airframe("airsim"))
    places = vehicle.position + np.array([[6.0, 0.0, 0.0], [6.0, 1.5, 0.0], [6.0, 3.0, 0.0]])
    for boxes, expected in ((np.array([box]), [False, False, True]), (np.empty((0, 6)), [True] * 3)):
        seen = np.zeros(3, dtype=np.bool_)
        CameraView(Camera(), 10.0, boxes).mark(vehicle, places, seen)
        assert seen.tolist() == expected
