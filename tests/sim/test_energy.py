from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.energy import power_w

FINITE = st.floats(-1e4, 1e4)


def test_hover_draws_its_constant() -> None:
    assert power_w(0.0, 0.0, 0.0, 0.0) == pytest.approx(444.34)


def test_power_worked_out_by_hand() -> None:
    # 7.2 km/h and 3.6 km/h/s level, 1.8 km/h and 1.08 km/h/s vertical:
    # -10.9872 + 14.1624 + 25.09056 + 32.625 + 104.34204 - 2.10924 + 444.34
    assert power_w(2.0, 1.0, 0.5, 0.3) == pytest.approx(607.46356)


def test_magnitude_of_the_papers_golden_flight() -> None:
    """Table III: 543 W on average at 0.52 m/s; moderate stop-and-go comes within 5 %."""
    assert power_w(0.52, 0.5, 0.2, 0.2) == pytest.approx(543.0, rel=0.05)


@given(FINITE, FINITE, FINITE, FINITE)
def test_power_is_never_negative_and_knows_no_direction(
    v_xy: float, a_xy: float, v_z: float, a_z: float
) -> None:
    power = power_w(v_xy, a_xy, v_z, a_z)
    assert power >= 0.0
    assert power == power_w(-v_xy, -a_xy, -v_z, -a_z)
