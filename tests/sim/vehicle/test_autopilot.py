from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.vehicle.airframe import GRAVITY_M_S2, ROTORS, airframe
from sim.vehicle.autopilot import RATE_P, YAW_RATE_P, Autopilot, Plant, mix
from sim.vehicle.vehicle import STEP_S, Vehicle
from tests.sim.worlds import world_with

AIRSIM = airframe("airsim")
PLANT = Plant(
    STEP_S,
    AIRSIM.mass_kg,
    *AIRSIM.inertia_kg_m2,
    AIRSIM.lever_m,
    AIRSIM.torque_per_thrust_m,
    AIRSIM.max_thrust_n,
    0.0,
    100.0,
)
SIGNS = np.array(ROTORS)


def wrench(thrust: np.ndarray) -> np.ndarray:
    """Lift and torques about x, y, z of four thrusts: moment of each force, plus its reaction torque."""
    x, y, spin = SIGNS.T
    lever, ratio = AIRSIM.lever_m, AIRSIM.torque_per_thrust_m
    return np.array([thrust.sum(), lever * y @ thrust, -lever * x @ thrust, ratio * spin @ thrust])


def mixed(lift: float, torque: tuple[float, float, float]) -> np.ndarray:
    thrust = np.empty(4)
    mix(lift, torque, PLANT, thrust)
    assert (thrust >= 0.0).all()
    assert (thrust <= AIRSIM.max_thrust_n).all()
    return thrust


@given(st.floats(12.0, 22.0), st.tuples(st.floats(-0.8, 0.8), st.floats(-0.8, 0.8), st.floats(-0.1, 0.1)))
def test_the_rotors_give_the_lift_and_torque_that_are_asked_for(
    lift: float, torque: tuple[float, float, float]
) -> None:
    assert wrench(mixed(lift, torque)) == pytest.approx([lift, *torque], abs=1e-9)


@given(st.floats(8.0, 25.0), st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.sampled_from([-5.0, 5.0]))
def test_yaw_gives_way_to_lift_roll_and_pitch(lift: float, roll: float, pitch: float, yaw: float) -> None:
    assert wrench(mixed(lift, (roll, pitch, yaw)))[:3] == pytest.approx([lift, roll, pitch], abs=1e-9)


@given(st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-0.3, 0.3)))
@settings(max_examples=30)
def test_body_rates_decay_in_the_physics_as_the_rate_loop_means_them_to(
    rates: tuple[float, float, float],
) -> None:
    """At rest but for body rates, so small that no rotor reaches a limit: they are to decay."""
    vehicle = Vehicle(world_with(), AIRSIM)
    vehicle.data.qvel[3:] = rates
    thrust = np.empty(4)
    Autopilot(AIRSIM, STEP_S, yaw_rad=0.0).update(vehicle.data.qpos, vehicle.data.qvel, thrust)
    vehicle.data.act[:] = thrust
    mujoco.mj_forward(vehicle.model, vehicle.data)
    assert vehicle.data.qacc[3:] == pytest.approx(-np.array([RATE_P, RATE_P, YAW_RATE_P]) * rates, abs=1e-6)
    assert vehicle.data.qacc[2] == pytest.approx(0.0, abs=1e-9)
    assert thrust.sum() == pytest.approx(AIRSIM.mass_kg * GRAVITY_M_S2)
