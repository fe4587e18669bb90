from __future__ import annotations

from math import sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.vehicle.airframe import AIR_DENSITY_KG_M3, GRAVITY_M_S2, airframe
from sim.vehicle.energy import induced_m_s, momentum_w, power_model, regression_w

FINITE = st.floats(-1e4, 1e4)


def test_hover_draws_its_constant() -> None:
    assert regression_w(0.0, 0.0, 0.0, 0.0) == pytest.approx(444.34)


def test_regression_worked_out_by_hand() -> None:
    # 7.2 km/h and 3.6 km/h/s level, 1.8 km/h and 1.08 km/h/s vertical:
    # -10.9872 + 14.1624 + 25.09056 + 32.625 + 104.34204 - 2.10924 + 444.34
    assert regression_w(2.0, 1.0, 0.5, 0.3) == pytest.approx(607.46356)


def test_magnitude_of_the_papers_golden_flight() -> None:
    """Table III: 543 W on average at 0.52 m/s; moderate stop-and-go comes within 5 %."""
    assert regression_w(0.52, 0.5, 0.2, 0.2) == pytest.approx(543.0, rel=0.05)


@given(FINITE, FINITE, FINITE, FINITE)
def test_power_is_never_negative_and_knows_no_direction(
    v_xy: float, a_xy: float, v_z: float, a_z: float
) -> None:
    power = regression_w(v_xy, a_xy, v_z, a_z)
    assert power >= 0.0
    assert power == regression_w(-v_xy, -a_xy, -v_z, -a_z)


AIRSIM, SPARK = airframe("airsim"), airframe("spark")
REST = (0.0, 0.0, 0.0)


def test_momentum_theory_in_hover_worked_out_by_hand() -> None:
    """2.431 kg on four discs of 0.08563 m^2: 5.962 N each, induced 5.331 m/s, 127.1 W ideal, 444.5 W."""
    assert induced_m_s(5.962, 0.085634, 0.0, 0.0) == pytest.approx(5.3307, abs=1e-3)
    assert momentum_w(power_model(AIRSIM, "momentum"), REST, REST) == pytest.approx(444.5, abs=0.5)


def test_both_models_agree_in_the_airsim_uavs_hover() -> None:
    hover = momentum_w(power_model(AIRSIM, "momentum"), REST, REST)
    assert hover == pytest.approx(regression_w(0.0, 0.0, 0.0, 0.0), rel=0.005)


def test_the_spark_hovers_for_its_published_sixteen_minutes() -> None:
    hover = momentum_w(power_model(SPARK, "airframe"), REST, REST)
    assert SPARK.battery_kj * 1000 / hover / 60 == pytest.approx(16.0, rel=0.01)


@given(st.floats(1.0, 50.0), st.floats(0.01, 1.0), st.floats(-1.0, 8.0), st.floats(0.0, 20.0))
def test_induced_velocity_solves_the_momentum_equation(
    thrust: float, area: float, axial: float, level: float
) -> None:
    hover = sqrt(thrust / (2 * AIR_DENSITY_KG_M3 * area))
    axial = max(axial, -hover / 2)
    induced = induced_m_s(thrust, area, axial, level)
    assert induced == pytest.approx(hover**2 / sqrt(level**2 + (axial + induced) ** 2), rel=1e-6)


def test_a_climb_costs_its_potential_energy_and_level_flight_less_than_hover() -> None:
    model = power_model(AIRSIM, "momentum")._replace(
        heave_drag_n_s_m=0.0, level_drag_n_s_m=0.0, hover_efficiency=1.0, avionics_w=0.0
    )
    hover, climb = momentum_w(model, REST, REST), momentum_w(model, (0.0, 0.0, 2.0), REST)
    # Axial climb (Leishman, eq. 2.35): V/2 + sqrt((V/2)^2 + v_h^2) through the disc, v_h = 5.331 m/s.
    through = 1.0 + sqrt(1.0 + 5.3307**2)
    assert climb == pytest.approx(2.431 * GRAVITY_M_S2 * through, rel=1e-3)
    assert momentum_w(model, (6.0, 0.0, 0.0), REST) < hover
