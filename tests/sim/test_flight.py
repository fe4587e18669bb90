"""A flight is what its specification says: every field that it reads changes it."""

from __future__ import annotations

import numpy as np
import pytest

from services.bus.messages import header
from services.bus.topics import TICK_NS
from services.models.mission import MissionSpec
from sim.flight import SimulatedFlight
from sim.sensors import telemetry

CALM = {"gust_m_s": (0.0, 0.0, 0.0)}


def flown(fields: dict[str, object], seconds: float = 4.0) -> SimulatedFlight:
    flight = SimulatedFlight(MissionSpec.model_validate(fields))
    for tick in range(round(seconds * 1e9 / TICK_NS)):
        flight.advance(tick * TICK_NS, [(tick * TICK_NS, np.array([0.5, 0.0, 0.3, 0.0]))])
    return flight


def test_the_same_specification_flies_the_same_flight_and_another_seed_other_gusts() -> None:
    positions = [flown({"seed": seed, "world": "farm"}).vehicle.position for seed in (1, 1, 2)]
    assert positions[0].tobytes() == positions[1].tobytes()
    assert not np.array_equal(positions[0], positions[2])


@pytest.mark.parametrize(
    "change",
    [
        {"wind": {"mean_m_s": (0.0, 2.0, 0.0), **CALM}},
        {"wind": {"gust_m_s": (1.0, 1.0, 1.0)}},
        {"airframe": "spark"},
        {"world": "factory"},
    ],
)
def test_what_the_vehicle_meets_shows_in_where_it_flies(change: dict[str, object]) -> None:
    base: dict[str, object] = {"wind": CALM}
    assert not np.allclose(flown(base | change).vehicle.position, flown(base).vehicle.position, atol=1e-4)


def test_energy_is_by_the_model_that_is_asked_for() -> None:
    energies = {
        energy: flown({"energy": energy}).qof(success=True, replans=0).energy_kj
        for energy in ("airframe", "regression", "momentum")
    }
    assert energies["airframe"] == energies["regression"] != energies["momentum"]


def test_drift_shows_in_odometry_but_not_in_the_flight() -> None:
    drifting, exact = flown({"odometry": {"drift_m_sqrt_s": 0.3}}), flown({})
    assert drifting.vehicle.position.tobytes() == exact.vehicle.position.tobytes()
    told = telemetry.odometry(header(0, "map"), drifting.vehicle, drifting.drift).pose.pose.position
    off = np.array([told.x, told.y, told.z]) - drifting.vehicle.position
    assert 0.05 < np.linalg.norm(off) < 3.0


def test_a_tick_holds_the_samples_that_the_imus_rate_makes() -> None:
    flight = SimulatedFlight(MissionSpec())
    before = flight.felt
    assert before is None
    counts = []
    for tick in range(25):
        flight.advance(tick * TICK_NS, [(tick * TICK_NS + 460_000, np.zeros(4))])
        assert flight.felt is not None
        counts.append(len(flight.felt.time_ns))
    assert set(counts) == {7, 8}
    assert sum(counts) == 190
