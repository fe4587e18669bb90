from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.vehicle.redundancy import RedundancyStudy, acceleration_m_s2, safe_velocity_m_s, study


def factors(**fields: object) -> list[float | None]:
    return [one.time_factor for one in study(RedundancyStudy.model_validate(fields))]


def test_tmr_costs_the_airsim_uav_little_and_the_spark_much() -> None:
    """The paper's Fig. 15: 1.06 and 1.91."""
    assert factors(airframe="airsim")[2] == pytest.approx(1.06, abs=0.01)
    assert factors(airframe="spark")[2] == pytest.approx(1.91, abs=0.03)


@pytest.mark.parametrize("airframe", ["airsim", "spark"])
def test_dmr_lies_between_simplex_and_tmr(airframe: str) -> None:
    simplex, dmr, tmr = factors(airframe=airframe)
    assert simplex == 1.0
    assert dmr is not None
    assert tmr is not None
    assert 1.0 < dmr < tmr


@given(st.floats(0.5, 50.0), st.floats(0.0, 5.0), st.floats(0.5, 100.0))
def test_from_the_safe_velocity_it_stops_at_the_end_of_its_sight(
    a: float, response: float, sight: float
) -> None:
    v = safe_velocity_m_s(a, response, sight)
    assert v * response + v**2 / (2 * a) == pytest.approx(sight)


def test_acceleration_worked_out_by_hand() -> None:
    # Lift of sqrt(2) weights at 45 degrees of tilt: 1 g up, 1 g level.
    assert acceleration_m_s2(2**0.5) == pytest.approx(9.81)
    assert acceleration_m_s2(0.9) == 0.0


def test_a_computer_too_heavy_to_lift_has_no_factor() -> None:
    simplex, _, tmr = study(RedundancyStudy(airframe="spark", computer_kg=0.2))
    assert simplex.time_factor == 1.0
    assert tmr.safe_velocity_m_s == 0.0
    assert tmr.time_factor is None


def test_a_slow_computer_hides_the_weight_of_its_copies() -> None:
    fast, slow = factors(response_s=0.289)[2], factors(response_s=1.87)[2]
    assert fast is not None
    assert slow is not None
    assert 1.0 < slow < fast
