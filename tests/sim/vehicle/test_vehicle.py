from __future__ import annotations

from math import degrees, exp, pi, radians, tan
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.models.equipment import Wind
from sim.vehicle.airframe import GRAVITY_M_S2, airframe
from sim.vehicle.vehicle import STEP_S, PhysicsDivergedError, Vehicle
from sim.vehicle.wind import Air
from tests.sim.worlds import world_with

AIRSIM = airframe("airsim")
HOVER = np.zeros(4)
SECOND = round(1 / STEP_S)


def tilt_deg(vehicle: Vehicle) -> float:
    return degrees(np.arccos(min(vehicle.rotation[2, 2], 1.0)))


def vehicle_with(*boxes: tuple[float, ...], start: tuple[float, float, float] = (0.0, 0.0, 5.0)) -> Vehicle:
    return Vehicle(world_with(*boxes, start=start), AIRSIM)


def test_it_hovers_where_it_starts() -> None:
    vehicle = vehicle_with()
    track = vehicle.advance(HOVER, 10 * SECOND)
    assert np.abs(track[:, 1:4] - (0.0, 0.0, 5.0)).max() < 1e-9
    assert np.abs(track[:, 4:10]).max() < 1e-9
    assert vehicle.time_s == pytest.approx(10.0)
    assert track[-1, 0] == pytest.approx(10.0)
    assert not vehicle.contact


def test_without_rotors_it_falls_as_gravity_and_drag_say() -> None:
    vehicle = vehicle_with(start=(0.0, 0.0, 100.0))
    vehicle.data.act[:] = vehicle.data.ctrl[:] = 0.0
    for _ in range(2 * SECOND):
        mujoco.mj_step(vehicle.model, vehicle.data)
    rate = AIRSIM.heave_drag_n_s_m / AIRSIM.mass_kg
    terminal = GRAVITY_M_S2 / rate
    speed = terminal * (1 - exp(-2 * rate))
    fallen = terminal * (2 - (1 - exp(-2 * rate)) / rate)
    assert vehicle.velocity == pytest.approx([0.0, 0.0, -speed], rel=2e-3)
    # Euler's method is ahead by half a step of the final speed.
    assert 100.0 - vehicle.position[2] == pytest.approx(fallen + speed * STEP_S / 2, rel=2e-3)


def test_a_rotor_follows_its_command_with_the_airframes_lag() -> None:
    vehicle = vehicle_with()
    before = vehicle.data.act.copy()
    vehicle.data.ctrl[:] = before + 1.0
    steps = round(AIRSIM.rotor_time_constant_s / STEP_S)
    for _ in range(steps):
        mujoco.mj_step(vehicle.model, vehicle.data)
    expected = 1 - exp(-steps * STEP_S / AIRSIM.rotor_time_constant_s)
    assert vehicle.data.act - before == pytest.approx(expected, abs=1e-6)


@given(heading=st.floats(-pi, pi))
@settings(max_examples=20)
def test_it_starts_nose_towards_the_goal(heading: float) -> None:
    goal = (50 * np.cos(heading), 50 * np.sin(heading), 9.0)
    vehicle = Vehicle(world_with(goal=goal), AIRSIM)
    assert np.cos(vehicle.yaw - heading) == pytest.approx(1.0)
    assert vehicle.rotation[:, 0] == pytest.approx([np.cos(heading), np.sin(heading), 0.0], abs=1e-9)


@given(
    heading=st.floats(-pi, pi),
    speed=st.floats(0.2, 4.0),
    climb=st.floats(-2.0, 2.0),
    yaw_rate=st.floats(-1.5, 1.5),
)
@settings(max_examples=40)
def test_a_step_in_the_command_settles(heading: float, speed: float, climb: float, yaw_rate: float) -> None:
    vehicle = vehicle_with(start=(0.0, 0.0, 50.0))
    wanted = np.array([speed * np.cos(heading), speed * np.sin(heading), climb])
    command = np.array([*wanted, yaw_rate])
    tilt, turned, yaw = 0.0, 0.0, vehicle.yaw
    velocities = []
    for _ in range(4 * 25):
        velocities.append(vehicle.advance(command, 10)[1:, 4:7])
        tilt = max(tilt, tilt_deg(vehicle))
        turned += (vehicle.yaw - yaw + pi) % (2 * pi) - pi
        yaw = vehicle.yaw
    velocity = np.concatenate(velocities)
    along = velocity @ wanted / np.linalg.norm(wanted)
    assert along.max() < 1.10 * np.linalg.norm(wanted) + 0.02
    settled = velocity[2 * SECOND :]
    assert np.abs(settled - wanted).max() < 0.08 * np.linalg.norm(wanted) + 0.05
    assert tilt < 34.0
    assert turned == pytest.approx(4 * yaw_rate, abs=0.1 + 0.1 * abs(yaw_rate))


@given(
    st.lists(
        st.tuples(
            st.tuples(*[st.sampled_from([0.0, 3.0, -6.0, 1e308, -1e308, float("inf"), float("nan")])] * 4),
            st.integers(1, 25),
        ),
        min_size=5,
        max_size=60,
    )
)
@settings(max_examples=30)
def test_no_command_brings_it_down(commands: list[tuple[tuple[float, ...], int]]) -> None:
    vehicle = vehicle_with(start=(0.0, 0.0, 200.0))
    for command, steps in commands:
        track = vehicle.advance(np.array(command), steps)
        assert np.hypot(track[:, 4], track[:, 5]).max() < 7.0
        assert np.abs(track[:, 6]).max() < 4.0
        assert tilt_deg(vehicle) < 40.0


def test_a_component_that_is_not_finite_leaves_the_last_one_in_force() -> None:
    valid, corrupted = vehicle_with(), vehicle_with()
    last = np.array([2.0, -1.0, 0.5, 0.3])
    for vehicle in (valid, corrupted):
        vehicle.advance(last, SECOND)
    expected = valid.advance(np.array([2.0, 1.0, 0.5, 0.3]), SECOND)
    flown = corrupted.advance(np.array([np.nan, 1.0, np.inf, -np.inf]), SECOND)
    assert flown.tobytes() == expected.tobytes()


def commands(seed: int) -> np.ndarray:
    return np.asarray(np.random.default_rng(seed).uniform((-3, -3, -0.5, -1.5), (3, 3, 0.5, 1.5), (125, 4)))


def test_five_seconds_repeat_bit_for_bit() -> None:
    box = (4.0, -1.5, 0.0, 7.0, 1.5, 20.0)
    pair = vehicle_with(box), vehicle_with(box)
    together = [[vehicle.advance(command, 10).tobytes() for vehicle in pair] for command in commands(seed=7)]
    assert all(one == other for one, other in together)
    again = vehicle_with(box)
    alone = [again.advance(command, 10).tobytes() for command in commands(seed=7)]
    assert alone == [one for one, _ in together]
    assert len(set(alone)) == len(alone)


def test_how_a_flight_is_cut_into_ticks_does_not_matter() -> None:
    whole, cut = vehicle_with(), vehicle_with()
    command = np.array([2.0, 1.0, 0.3, 0.5])
    track = whole.advance(command, 60)
    parts = [cut.advance(command, steps) for steps in (1, 9, 20, 30)]
    assert np.concatenate([parts[0], *(part[1:] for part in parts[1:])]).tobytes() == track.tobytes()


def test_hover_thrust_is_the_weight() -> None:
    vehicle = vehicle_with()
    vehicle.advance(HOVER, SECOND)
    assert vehicle.data.act.sum() == pytest.approx(AIRSIM.weight_n, rel=1e-6)


@pytest.mark.parametrize("frame", ["airsim", "spark"])
def test_a_step_in_velocity_rises_as_its_loops_say(frame: str) -> None:
    """Velocity loop of 2.4 1/s round the attitude loop of 6 1/s: 63 % within 0.45 to 0.75 s."""
    vehicle = Vehicle(world_with(), airframe(frame))
    track = vehicle.advance(np.array([1.0, 0.0, 0.0, 0.0]), 3 * SECOND)
    risen = track[np.argmax(track[:, 4] > 1 - exp(-1)), 0]
    assert 0.45 < risen < 0.75
    assert track[-1, 4] == pytest.approx(1.0, abs=0.06)


def test_a_large_step_flies_at_the_tilt_limit() -> None:
    """The limit leaves g tan(30 deg) = 5.66 m/s^2 of push against inertia and drag."""
    vehicle = vehicle_with(start=(0.0, 0.0, 50.0))
    tilt, fastest = 0.0, 0.0
    for _ in range(30):
        track = vehicle.advance(np.array([6.0, 0.0, 0.0, 0.0]), 10)
        tilt = max(tilt, tilt_deg(vehicle))
        push = np.diff(track[:, 4]) / STEP_S + AIRSIM.level_drag_n_s_m / AIRSIM.mass_kg * track[1:, 4]
        fastest = max(fastest, float(push.max()))
    assert tilt == pytest.approx(30.0, abs=3.0)
    assert fastest == pytest.approx(GRAVITY_M_S2 * tan(radians(30.0)), rel=0.1)


def test_in_a_steady_wind_it_holds_its_velocity_by_leaning_into_it() -> None:
    wind = Wind(mean_m_s=(4.0, 0.0, 0.0), gust_m_s=(0.0, 0.0, 0.0))
    vehicle = Vehicle(world_with(), AIRSIM, Air(wind, 0, STEP_S))
    vehicle.advance(HOVER, 15 * SECOND)
    assert np.abs(vehicle.velocity).max() < 0.02
    lean = AIRSIM.level_drag_n_s_m * 4.0 / AIRSIM.weight_n
    assert tan(radians(tilt_deg(vehicle))) == pytest.approx(lean, rel=0.02)
    assert vehicle.rotation[0, 2] < 0, "upwind"


def test_flying_into_a_wall_is_a_contact_at_the_moment_the_hull_reaches_it() -> None:
    vehicle = vehicle_with((6.0, -50.0, 0.0, 9.0, 50.0, 20.0))
    tracks = [vehicle.advance(np.array([2.0, 0.0, 0.0, 0.0]), 10) for _ in range(100)]
    track = np.concatenate([tracks[0], *(part[1:] for part in tracks[1:])])
    assert vehicle.contact_step is not None
    assert track[vehicle.contact_step, 1] + AIRSIM.hull_radius_m == pytest.approx(6.0, abs=0.02)
    before = track[: vehicle.contact_step, 1] + AIRSIM.hull_radius_m
    assert before.max() < 6.0 + 0.001


def test_passing_a_wall_closely_is_no_contact() -> None:
    near = AIRSIM.hull_radius_m + 0.05
    vehicle = vehicle_with((-50.0, near, 0.0, 50.0, near + 3.0, 20.0))
    vehicle.advance(np.array([2.0, 0.0, 0.0, 0.0]), 5 * SECOND)
    assert vehicle.position[0] > 5.0
    assert not vehicle.contact


def test_the_ground_is_a_contact() -> None:
    vehicle = vehicle_with(start=(0.0, 0.0, 1.0))
    vehicle.advance(np.array([0.0, 0.0, -1.0, 0.0]), 3 * SECOND)
    assert vehicle.contact
    assert vehicle.position[2] == pytest.approx(AIRSIM.hull_height_m / 2, abs=0.02)


def test_a_state_that_is_not_finite_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file there
    vehicle = vehicle_with()
    vehicle.data.qvel[0] = np.nan
    with pytest.raises(PhysicsDivergedError, match="not finite after"):
        vehicle.advance(HOVER, 1)
