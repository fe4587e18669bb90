from __future__ import annotations

import pytest

from sim.airframe import UnknownAirframeError, airframe


def test_airsim_airframe_matches_its_published_figures() -> None:
    airsim = airframe("airsim")
    assert airsim.max_thrust_n == pytest.approx(8.40, abs=0.01)
    assert airsim.thrust_to_weight == pytest.approx(1.41, abs=0.005)
    assert airsim.battery_kj == pytest.approx(219.8, abs=0.1)
    # Published rotor: C_P rho n^2 D^5 / (2 pi) = 0.546 N m at full speed.
    assert airsim.torque_per_thrust_m * airsim.max_thrust_n == pytest.approx(0.546, abs=0.001)


def test_inertia_is_that_of_a_flat_body() -> None:
    x, y, z = airframe("airsim").inertia_kg_m2
    assert x == y
    assert max(x, y) < z < x + y


def test_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownAirframeError, match=r"'arisim'; known: .*airsim"):
        airframe("arisim")
