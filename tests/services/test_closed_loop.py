"""The pilot flies: 50 m through boxes without touching one, with every planner, and after a restart."""

import numpy as np
import pytest

from services.control.following import follower
from services.models.mission import MissionSpec
from services.perception.collision import CollisionCounter
from services.perception.occupancy import OccupancyMap
from services.planning.pilot import Navigator, Tactics
from tests.services.closed_loop import GOAL, Latencies, Loop, fly, scattered, wall


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in (1, 2))])
@pytest.mark.parametrize("size_m", [3.0, 5.0])
def test_it_arrives_among_many_boxes(seed: int, size_m: float) -> None:
    flight = fly(scattered(100 + seed, 0.2, size_m), seed)
    assert flight.result == "success"
    assert flight.time_s < 60.0
    assert flight.clearance_m > 0.3


@pytest.mark.parametrize("seed", range(2))
def test_it_arrives_among_few_boxes_soon(seed: int) -> None:
    flight = fly(scattered(seed, 0.05, 3.0), seed)
    assert flight.result == "success"
    assert flight.time_s < 35.0


@pytest.mark.parametrize("planner", ["rrt", "rrt_connect", "rrt_star"])
def test_it_finds_the_way_around_a_wall(planner: str) -> None:
    flight = fly(wall(), 3, planner)
    assert flight.result == "success"
    assert flight.plans > 1
    assert flight.clearance_m > 0.3


def test_the_same_seed_gives_the_same_flight_and_another_seed_another() -> None:
    traces = [np.array(fly(wall(), seed).trace) for seed in (1, 1, 2)]
    assert np.array_equal(traces[0], traces[1])
    assert not np.array_equal(traces[0], traces[2])


@pytest.mark.parametrize("stage", ["perception", "planning", "control"])
@pytest.mark.parametrize("when_s", [5.0, pytest.param(9.5, marks=pytest.mark.soak)])
def test_a_stage_that_lost_its_memory_in_flight_is_no_accident(stage: str, when_s: float) -> None:
    loop = Loop(wall(), 4, "rrt_star", Latencies())
    assert loop.run(when_s).result == "timeout"
    if stage == "perception":
        loop.occupancy, loop.counter, loop.perceived = OccupancyMap(), CollisionCounter(), None
    elif stage == "planning":
        loop.navigator, loop.planned = Navigator(GOAL, loop.latencies.planning_s, Tactics()), None
    else:
        loop.follower = follower(MissionSpec())
        loop.follower.take_trajectory(*loop.published[:3])
    assert loop.run(120.0).result == "success"


def test_walled_in_it_gives_up() -> None:
    room = np.array([[-6.0, -5, -6, 6], [5, 6, -6, 6], [-6, 6, 5, 6], [-6, 6, -6, -5]])
    flight = fly(room, 1)
    assert flight.result == "no_path"
    assert flight.clearance_m > 0.3
