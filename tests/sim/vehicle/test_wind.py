from __future__ import annotations

import numpy as np
import pytest

from services.models.equipment import Odometry, Wind
from sim.sensors.odometry import Drift
from sim.vehicle.wind import Air

STATED = Wind(mean_m_s=(1.0, -2.0, 0.5), gust_m_s=(0.8, 0.4, 0.2), correlation_s=0.5)


def test_gusts_have_the_stated_mean_deviation_and_correlation() -> None:
    wind = Air(STATED, 1, 0.004).velocity(0, 400_000)
    assert wind.mean(axis=0) == pytest.approx(STATED.mean_m_s, abs=0.08)
    assert wind.std(axis=0) == pytest.approx(STATED.gust_m_s, rel=0.06)
    gust = wind - wind.mean(axis=0)
    lag = round(0.5 / 0.004)
    kept = (gust[lag:] * gust[:-lag]).mean(axis=0) / gust.var(axis=0)
    assert kept == pytest.approx([np.exp(-1)] * 3, abs=0.06)


def test_gusts_repeat_with_the_seed_however_they_are_asked_for() -> None:
    whole = Air(STATED, 5, 0.004).velocity(0, 1200)
    air, parts, step = Air(STATED, 5, 0.004), [], 0
    for steps in (3, 500, 9, 12, 600, 76):
        parts.append(air.velocity(step, steps))
        step += steps
    assert np.concatenate(parts).tobytes() == whole.tobytes()
    assert not np.array_equal(Air(STATED, 6, 0.004).velocity(0, 1200), whole)


def test_drift_is_a_random_walk_of_the_stated_size() -> None:
    ends = []
    for seed in range(60):
        drift = Drift(Odometry(drift_m_sqrt_s=0.1), seed, 0.04)
        for _ in range(400):
            drift.advance()
        ends.append(drift.offset)
    assert np.std(ends) == pytest.approx(0.1 * 4.0, rel=0.2)


def test_without_drift_odometry_is_exact() -> None:
    drift = Drift(Odometry(), 3, 0.04)
    drift.advance()
    assert not drift.offset.any()
