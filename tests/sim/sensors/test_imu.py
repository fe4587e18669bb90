from __future__ import annotations

import numpy as np
import pytest

from services.models.equipment import Imu
from sim.sensors.imu import ImuSamples, InertialUnit
from sim.vehicle.airframe import GRAVITY_M_S2, airframe
from sim.vehicle.vehicle import STEP_S, Vehicle
from tests.sim.worlds import world_with

AIRSIM = airframe("airsim")
EXACT = Imu(gyro_noise_rad_s=0, gyro_bias_rad_s=0, accel_noise_m_s2=0, accel_bias_m_s2=0)


def flown(unit: InertialUnit, seconds: float, command: tuple[float, ...], cut: int = 10) -> ImuSamples:
    vehicle = Vehicle(world_with(), AIRSIM)
    steps = round(seconds / STEP_S)
    parts = [unit.sample(vehicle.advance(np.array(command), cut)) for _ in range(steps // cut)]
    return ImuSamples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def test_it_samples_at_its_own_rate() -> None:
    samples = flown(InertialUnit(EXACT, 0), 10.0, (0.0,) * 4)
    assert len(samples.time_ns) == 1900
    gaps = np.diff(samples.time_ns)
    assert set(gaps.tolist()) == {4_000_000, 8_000_000}, "whole physics steps"
    wanted = np.arange(1, 1901) / 190
    late = samples.time_ns / 1e9 - wanted
    assert (late > -1e-9).all()
    assert (late < STEP_S).all()


def test_in_hover_it_feels_gravity_only() -> None:
    samples = flown(InertialUnit(EXACT, 0), 2.0, (0.0,) * 4)
    assert samples.force == pytest.approx(np.tile([0.0, 0.0, GRAVITY_M_S2], (380, 1)), abs=1e-6)
    assert np.abs(samples.rates).max() < 1e-6


def test_it_agrees_with_the_flight() -> None:
    vehicle, unit = (
        Vehicle(world_with(), AIRSIM),
        InertialUnit(EXACT.model_copy(update={"rate_hz": 250.0}), 0),
    )
    track = vehicle.advance(np.array([3.0, 0.0, 0.0, 0.5]), 100)
    samples = unit.sample(track)
    assert samples.rates == pytest.approx(track[1:, 7:10])
    # Rotors push along the body's z only, so what is felt along x and y is drag.
    drag = -AIRSIM.level_drag_n_s_m / AIRSIM.mass_kg * vehicle.rotation.T @ vehicle.velocity
    assert samples.force[-1, :2] == pytest.approx(drag[:2], abs=0.02)


def test_bias_and_noise_are_what_is_stated_and_repeat() -> None:
    stated = Imu(gyro_noise_rad_s=0.01, gyro_bias_rad_s=0.05, accel_noise_m_s2=0.1, accel_bias_m_s2=0.2)
    exact = flown(InertialUnit(EXACT, 0), 10.0, (0.0,) * 4)
    biases = []
    for seed in range(8):
        noisy = flown(InertialUnit(stated, seed), 10.0, (0.0,) * 4)
        error = noisy.force - exact.force
        assert error.std(axis=0) == pytest.approx([0.1] * 3, rel=0.1)
        assert (noisy.rates - exact.rates).std(axis=0) == pytest.approx([0.01] * 3, rel=0.1)
        biases.append(error.mean(axis=0))
    assert 0.1 < np.std(biases) < 0.35
    again, cut = (flown(InertialUnit(stated, 7), 10.0, (0.0,) * 4, cut) for cut in (10, 25))
    assert again.force.tobytes() == noisy.force.tobytes() == cut.force.tobytes()
