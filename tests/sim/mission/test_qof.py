from __future__ import annotations

from itertools import pairwise

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.mission.qof import FlightMeter, Hull, hull_clearance
from sim.vehicle.airframe import airframe
from sim.vehicle.energy import regression_w
from sim.vehicle.vehicle import TRACK_WIDTH, Vehicle
from tests.sim.worlds import world_with

AIRSIM = airframe("airsim")
HULL = Hull(AIRSIM.hull_radius_m, AIRSIM.hull_height_m / 2)


def flown(rows: list[list[float]]) -> np.ndarray:
    """A track from time, position and velocity, level and not turning."""
    track = np.zeros((len(rows), TRACK_WIDTH))
    track[:, :7] = rows
    track[:, 10] = 1.0
    return track


def test_a_flight_worked_out_by_hand() -> None:
    """10 s hover; 2 s level from rest to 2 m/s; 5 s cruise; 1 s of pulling up to 1 m/s of climb."""
    track = flown(
        [
            [0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0],
            [10.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0],
            [12.0, 2.0, 0.0, 2.0, 2.0, 0.0, 0.0],
            [17.0, 12.0, 0.0, 2.0, 2.0, 0.0, 0.0],
            [18.0, 14.0, 0.0, 2.5, 2.0, 0.0, 1.0],
        ]
    )
    meter = FlightMeter(world_with((5.0, 3.0, 0.0, 8.0, 6.0, 20.0)), AIRSIM)
    meter.add(track[:3])
    meter.add(track[2:])
    qof = meter.qof(success=True, replans=3)
    assert qof.flight_time_s == 18.0
    assert qof.distance_m == pytest.approx(2.0 + 10.0 + np.hypot(2.0, 0.5))
    # By hand, W: hover 444.34; 3.6 km/h and 3.6 km/h/s: 465.554; 7.2 km/h: 433.3528;
    # 7.2 km/h with 1.8 km/h and 3.6 km/h/s upwards: 433.3528 + 32.625 + 347.8068 - 7.0308.
    joule = 10 * 444.34 + 2 * 465.55368 + 5 * 433.3528 + 1 * 806.7538
    assert qof.energy_kj == pytest.approx(joule / 1000)
    assert (qof.success, qof.replans) == (True, 3)
    # A full charge is 11.1 V, 5.5 Ah: 219.78 kJ.
    assert qof.state_of_charge == pytest.approx(1 - joule / 219_780)
    assert qof.missions_per_charge == pytest.approx(219_780 / joule)
    assert meter.qof(success=False, replans=3).missions_per_charge == 0.0
    assert qof.min_clearance_m == pytest.approx(np.hypot(3.0, 3.0) - AIRSIM.hull_radius_m)


def test_a_flight_by_momentum_theory_worked_out_by_hand() -> None:
    """10 s of hover at 444.5 W; then 5 s of climb at 2 m/s: 23.848 + 4.1 N against the heave drag, so
    v_h = 5.771 m/s and 1 + sqrt(1 + v_h^2) = 6.857 m/s through the discs: 27.948 * 6.857 / 0.286 = 670.1 W.
    """
    meter = FlightMeter(world_with(), AIRSIM, "momentum")
    meter.add(flown([[0.0, 0, 0, 2, 0, 0, 0], [10.0, 0, 0, 2, 0, 0, 0]]))
    meter.add(flown([[10.0, 0, 0, 2, 0, 0, 2], [15.0, 0, 0, 12, 0, 0, 2]]))
    assert meter.qof(success=True, replans=0).energy_kj == pytest.approx(10 * 0.4445 + 5 * 0.6701, rel=1e-3)


def test_hovering_costs_hover_power_and_no_distance() -> None:
    world = world_with()
    vehicle, meter = Vehicle(world, AIRSIM), FlightMeter(world, AIRSIM)
    for _ in range(50):
        meter.add(vehicle.advance(np.zeros(4), 10))
    qof = meter.qof(success=False, replans=0)
    assert qof.flight_time_s == pytest.approx(2.0)
    assert qof.energy_kj == pytest.approx(2 * regression_w(0, 0, 0, 0) / 1000)
    assert qof.distance_m == pytest.approx(0.0, abs=1e-6)


@given(st.lists(st.integers(1, 199), unique=True, max_size=8))
@settings(max_examples=20)
def test_how_a_flight_is_cut_does_not_matter(cuts: list[int]) -> None:
    world = world_with((3.0, 1.0, 0.0, 6.0, 4.0, 20.0))
    track = Vehicle(world, AIRSIM).advance(np.array([2.0, 1.0, 0.5, 0.0]), 200)
    whole, parts = FlightMeter(world, AIRSIM), FlightMeter(world, AIRSIM)
    whole.add(track)
    for begin, end in pairwise([0, *sorted(cuts), 200]):
        parts.add(track[begin : end + 1])
    assert parts.qof(success=True, replans=0) == whole.qof(success=True, replans=0)


@given(
    position=st.tuples(st.floats(-8.0, 8.0), st.floats(-8.0, 8.0), st.floats(0.2, 9.0)),
    top=st.floats(1.0, 8.0),
)
@settings(max_examples=60)
def test_clearance_is_the_distance_that_the_physics_measures(
    position: tuple[float, float, float], top: float
) -> None:
    box = (-1.0, -2.0, 0.5, 1.0, 1.0, top)
    vehicle = Vehicle(world_with(box, start=position), AIRSIM)
    geom = {vehicle.model.geom_type[i]: i for i in range(vehicle.model.ngeom)}
    hull, obstacle = geom[mujoco.mjtGeom.mjGEOM_CYLINDER], geom[mujoco.mjtGeom.mjGEOM_BOX]
    measured = mujoco.mj_geomDistance(vehicle.model, vehicle.data, hull, obstacle, 100.0, None)
    clearance = hull_clearance(np.array(position), np.array([box]), HULL)
    assert clearance == pytest.approx(max(measured, 0.0), abs=1e-3)


def test_a_collision_leaves_no_clearance() -> None:
    world = world_with((4.0, -5.0, 0.0, 7.0, 5.0, 20.0), (90.0, 90.0, 0.0, 93.0, 93.0, 20.0))
    vehicle, meter = Vehicle(world, AIRSIM), FlightMeter(world, AIRSIM)
    while not vehicle.contact:
        assert vehicle.time_s < 10.0
        meter.add(vehicle.advance(np.array([1.5, 0.0, 0.0, 0.0]), 10))
    assert meter.qof(success=False, replans=0).min_clearance_m < 0.01
