"""Obstacles that move: where they are, and that camera, contact and clearance meet them there."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from services.models.equipment import Camera
from sim.mission.qof import FlightMeter
from sim.moving import swept
from sim.moving_boxes import boxes_at
from sim.sensors.camera import DepthCamera
from sim.vehicle.airframe import airframe
from sim.vehicle.vehicle import STEP_S, Vehicle
from sim.world import DEFINITION, BadWorldError, World, make_world, to_toml

# A wall 10 m ahead that comes to 4 m and goes back: 6 m in 10 s.
COMING = {
    "name": "coming",
    "kind": "boxes",
    "start": [0.0, 0.0, 2.0],
    "goal": [30.0, 0.0, 2.0],
    "boxes": [[40.0, 40.0, 0.0, 41.0, 41.0, 9.0]],
    "moving": [
        {"box": [10.0, -9.0, 0.0, 11.0, 9.0, 9.0], "travel_m": [-6.0, 0.0, 0.0], "period_s": 20.0},
    ],
}


def coming(**changes: object) -> World:
    return make_world(DEFINITION.validate_python(COMING | changes), 0)


def ahead(vehicle: Vehicle) -> float:
    return float(DepthCamera(Camera(noise_per_m=0.0, quantisation_m=0.0), 0).render(vehicle)[18, 32])


def test_an_obstacle_goes_to_the_other_end_and_comes_back() -> None:
    world = coming()
    places = [float(world.moved(time_s)[0, 0]) for time_s in (0.0, 5.0, 10.0, 15.0, 20.0, 1e6)]
    assert places == pytest.approx([10.0, 7.0, 4.0, 7.0, 10.0, 10.0])
    assert swept(world.moving)[0].tolist() == [4.0, -9.0, 0.0, 11.0, 9.0, 9.0]


def test_a_phase_is_where_it_begins() -> None:
    begun = boxes_at(np.array([[0, 0, 0, 1, 1, 1, 8, 0, 0, 4, 0.25]], dtype=float), 0.0)
    assert begun[0].tolist() == [4.0, 0.0, 0.0, 5.0, 1.0, 1.0]


def test_the_camera_sees_it_where_it_is() -> None:
    vehicle = Vehicle(coming(), airframe("airsim"))
    assert ahead(vehicle) == pytest.approx(10.0, abs=0.05)
    vehicle.advance(np.zeros(4), round(5.0 / STEP_S))
    x = float(vehicle.position[0])
    assert ahead(vehicle) == pytest.approx(7.0 - x, abs=1e-3)


def test_it_strikes_a_vehicle_that_hovers_and_clearance_says_when() -> None:
    world = coming(goal=[-20.0, 0.0, 2.0], start=[3.0, 0.0, 2.0])
    frame = airframe("airsim")
    vehicle, meter = Vehicle(world, frame), FlightMeter(world, frame)
    touched_s = (10.0 - 3.0 - frame.hull_radius_m) / 0.6
    assert touched_s > 10.0  # it turns before it is there
    closest = 1.0 - frame.hull_radius_m
    meter.add(vehicle.advance(np.zeros(4), round(20.0 / STEP_S)))
    assert not vehicle.contact
    assert meter.qof(success=True, replans=0).min_clearance_m == pytest.approx(closest, abs=0.05)

    nearer = coming(goal=[-20.0, 0.0, 2.0], start=[3.9, 0.0, 2.0])
    struck, counting = Vehicle(nearer, frame), FlightMeter(nearer, frame)
    counting.add(struck.advance(np.zeros(4), round(12.0 / STEP_S)))
    assert struck.contact_step is not None
    assert struck.contact_step * STEP_S == pytest.approx((10.0 - 3.9 - frame.hull_radius_m) / 0.6, abs=0.1)
    assert counting.qof(success=False, replans=0).min_clearance_m == 0.0


def test_how_a_flight_is_cut_into_ticks_changes_nothing() -> None:
    frame = airframe("airsim")
    whole, parts = Vehicle(coming(), frame), Vehicle(coming(), frame)
    track = whole.advance(np.zeros(4), 100)
    for _ in range(10):
        last = parts.advance(np.zeros(4), 10)
    assert track[-1].tobytes() == last[-1].tobytes()
    assert ahead(whole) == ahead(parts)


def test_an_exported_world_moves_the_same() -> None:
    drawn = make_world("traffic", 3)
    again = make_world(DEFINITION.validate_python(tomllib.loads(to_toml(drawn))), 99)
    assert again.obstacles.tobytes() == drawn.obstacles.tobytes()
    assert again.moving.tobytes() == drawn.moving.tobytes()
    assert again.moved(7.0).tobytes() == drawn.moved(7.0).tobytes()


@pytest.mark.parametrize(
    ("moving", "says"),
    [
        ({"box": [10.0, 0.0, 0.0, 9.0, 1.0, 1.0]}, "moving.0.box .*lower corner not below"),
        ({"box": [-12.0, -1.0, 0.0, -10.0, 1.0, 9.0], "travel_m": [20.0, 0.0, 0.0]}, "start .* the way of"),
    ],
)
def test_an_obstacle_that_cannot_be_is_refused(moving: dict[str, object], says: str) -> None:
    stated = {"travel_m": [1.0, 0.0, 0.0], "period_s": 5.0} | moving
    with pytest.raises(BadWorldError, match=says):
        coming(moving=[stated])
