from __future__ import annotations

import pytest

from services.models.airframe import AirframeDefinition
from sim.vehicle.airframe import BadAirframeError, airframe


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


def test_a_definition_of_ones_own_becomes_an_airframe() -> None:
    fields = airframe("airsim").model_dump() | {"name": "mine", "max_rpm": 12_000.0}
    mine = airframe(AirframeDefinition.model_validate(fields))
    assert mine.thrust_to_weight == pytest.approx(1.409 * (12 / 8.75) ** 2, rel=1e-3)


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [("max_rpm", 7000.0, r"max_rpm 7000"), ("motor_kg", 0.7, r"motor_kg 0.7"), ("mass_kg", 3.0, "lift of")],
)
def test_an_airframe_that_could_not_fly_is_refused(field: str, value: float, says: str) -> None:
    fields = airframe("airsim").model_dump() | {field: value}
    with pytest.raises(BadAirframeError, match=says):
        airframe(AirframeDefinition.model_validate(fields))


def test_the_spark_matches_its_published_figures() -> None:
    spark = airframe("spark")
    assert spark.mass_kg == 0.3
    assert spark.battery_kj / 3.6 == pytest.approx(16.87, abs=0.01)
    assert spark.thrust_to_weight == pytest.approx(1.62, abs=0.005)


def test_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(BadAirframeError, match=r"'arisim'; known: .*airsim"):
        airframe("arisim")
