from __future__ import annotations

import numpy as np
import pytest

from services.models.outcome import MissionResult
from sim.mission.referee import ARRIVAL_SPEED_M_S, GOAL_RADIUS_M, arrived, judge
from sim.vehicle.airframe import airframe
from sim.vehicle.vehicle import STEP_S, Vehicle
from tests.sim.worlds import world_with

GOAL = np.array([25.0, 5.0, 2.0])


def verdict(
    off_m: float = 20.0,
    speed: float = 0.0,
    time_s: float = 60.0,
    *,
    contact: bool = False,
    no_path: bool = False,
) -> MissionResult | None:
    position, velocity = GOAL - np.array([0.6, 0.0, 0.8]) * off_m, np.array([0.0, 0.8, -0.6]) * speed
    return judge(
        200.0,
        time_s=time_s,
        accomplished=arrived(GOAL, position, velocity),
        contact=contact,
        no_path=no_path,
    )


@pytest.mark.parametrize(
    ("result", "expected"),
    [
        (verdict(), None),
        (verdict(off_m=0.99, speed=0.99), "success"),
        (verdict(off_m=1.01), None),
        (verdict(off_m=0.5, speed=1.01), None),
        (verdict(contact=True), "collision"),
        (verdict(no_path=True), "no_path"),
        (verdict(time_s=199.96), None),
        (verdict(time_s=200.0), "timeout"),
        (verdict(off_m=0.5, contact=True, no_path=True, time_s=200.0), "collision"),
        (verdict(off_m=0.5, no_path=True, time_s=200.0), "success"),
        (verdict(no_path=True, time_s=200.0), "no_path"),
    ],
)
def test_the_end_of_a_mission(result: MissionResult | None, expected: MissionResult | None) -> None:
    assert result == expected


def test_a_nan_position_is_no_arrival() -> None:
    assert verdict(off_m=float("nan")) is None


def test_what_arrives_can_stop_within_the_goal_radius() -> None:
    vehicle = Vehicle(world_with(), airframe("airsim"))
    vehicle.advance(np.array([ARRIVAL_SPEED_M_S, 0.0, 0.0, 0.0]), round(6 / STEP_S))
    arrived = vehicle.position
    track = vehicle.advance(np.zeros(4), round(6 / STEP_S))
    assert np.abs(track[:, 1:4] - arrived).max() < GOAL_RADIUS_M / 2
