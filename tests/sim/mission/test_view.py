"""What counts as covered and as seen."""

from __future__ import annotations

import numpy as np

from services.models.equipment import Camera
from sim.mission.view import CameraView, mark_overflown
from sim.vehicle.airframe import airframe
from sim.vehicle.vehicle import Vehicle
from tests.sim.worlds import world_with


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
