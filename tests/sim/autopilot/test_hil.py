"""What an autopilot is told is what is: frames turned as MAVLink has them."""

from __future__ import annotations

from math import cos, nan, pi, sin

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from services.bus.arrays import turned
from services.models.equipment import Imu
from sim.autopilot.hil import (
    HilSensors,
    HilState,
    gps,
    relative_thrusts,
    specific_force,
    to_frd,
    to_ned,
    to_ned_frd,
    truth,
)

NOISELESS = Imu(gyro_noise_rad_s=0, accel_noise_m_s2=0)
SOUTH_EAST = np.array([3.0, -4.0, 1.0])


def state(attitude: np.ndarray, velocity: np.ndarray = SOUTH_EAST) -> HilState:
    force = specific_force(velocity, velocity, 0.004, attitude)
    return HilState(np.array([10.0, 20.0, 3.0]), velocity, attitude, np.array([0.1, 0.2, 0.3]), force)


def test_attitudes_turn_body_vectors_into_the_world_in_both_conventions() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        q = rng.standard_normal(4)
        q /= np.linalg.norm(q)
        seen = rng.standard_normal(3)
        ours = Rotation.from_quat(q[[1, 2, 3, 0]]).apply(seen)
        theirs = Rotation.from_quat(np.array(to_ned_frd(q))[[1, 2, 3, 0]]).apply(to_frd(seen))
        assert theirs == pytest.approx(to_ned(ours))


def test_nose_east_is_a_heading_of_90_degrees() -> None:
    assert to_ned_frd(np.array([1.0, 0, 0, 0])) == pytest.approx((cos(pi / 4), 0, 0, sin(pi / 4)))
    assert to_ned_frd(turned(pi / 2)) == pytest.approx((1, 0, 0, 0))


def test_at_rest_the_accelerometer_reads_one_g_upwards() -> None:
    read = HilSensors(NOISELESS, 1).sensor(state(np.array([1.0, 0, 0, 0])))
    assert (read["xacc"], read["yacc"]) == pytest.approx((0, 0))
    assert read["zacc"] == pytest.approx(-9.81)
    assert read["ygyro"] == pytest.approx(-0.2)
    assert 950 < read["abs_pressure"] < 960  # type: ignore[operator]


def test_position_and_velocity_are_those_of_the_vehicle() -> None:
    fix = gps(state(turned(0.0)))
    assert (fix["vn"], fix["ve"], fix["vd"], fix["vel"]) == (-400, 300, -100, 500)
    assert fix["alt"] == 491_000
    assert fix["lat"] / 1e7 - 47.397742 == pytest.approx(20 / 111_194.9, rel=1e-3)  # type: ignore[operator]
    told = truth(state(turned(0.0)))
    assert (told["vx"], told["vy"], told["vz"]) == (-400, 300, -100)
    assert told["zacc"] == -1000


def test_readings_repeat_with_the_seed() -> None:
    at = state(turned(0.3))
    first, again, other = (HilSensors(Imu(), seed) for seed in (1, 1, 2))
    assert first.sensor(at) == again.sensor(at) != other.sensor(at)
    assert first.sensor(at) != first.sensor(at)


def test_a_rotors_thrust_goes_with_the_square_of_its_motors_control() -> None:
    front_right, rear_left, front_left, rear_right = 0.1, 0.5, nan, 2.0
    thrusts = relative_thrusts((front_right, rear_left, front_left, rear_right, *[0.9] * 12))
    assert thrusts == pytest.approx([0.0, 0.25, 1.0, 0.01])  # front left, rear left, rear right, front right
