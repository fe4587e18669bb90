"""What a protection costs flights without a fault, with its interval."""

from dataclasses import replace

import pytest

from dashboard.design.overheads import (
    GoldenFlight,
    RelativeOverhead,
    added,
    cost,
    golden_flights,
    mean_overhead,
)
from deploy.errors import BadSpecError
from tests.dashboard.campaigns.test_flight_record import GOLDEN, result
from tests.dashboard.campaigns.test_flight_record import records as recorded

PLACES = [("sparse", number) for number in range(4)]
BARE = {place: GoldenFlight(True, 20.0, 10.0) for place in PLACES}


def test_golden_flights_are_twins_and_flights_without_a_fault() -> None:
    own, twin = result(time_s=25.0), result(injection="injected", time_s=99.0)
    unpaired = replace(twin, twin_success=None)
    found = golden_flights(recorded(GOLDEN, [own, twin, unpaired, None]))
    assert found == {
        ("sparse", 0): GoldenFlight(True, 25.0, 10.0),
        ("sparse", 1): GoldenFlight(True, 20.0, 10.0),
    }


def test_overheads_are_means_of_pairs_with_students_interval() -> None:
    times = dict(zip(PLACES, (20.0, 21.0, 22.0, 0.0), strict=True))
    slower = {place: GoldenFlight(time > 0, time, 12.0) for place, time in times.items()}
    found = cost("finite", BARE, slower)
    assert (found.pairs, found.arrived, found.lost) == (4, 4, 1)
    # 1 of 4: the upper root of Clopper's and Pearson's equation
    assert found.lost_high == pytest.approx(0.8058795, rel=1e-6)
    # Means of 0, 5 and 10 %; Student's quantile of two degrees of freedom is 4.302652730
    assert found.flight_time.mean == pytest.approx(0.05, rel=1e-9)
    assert found.flight_time.high == pytest.approx(0.05 + 4.302652730 * 0.05 / 3**0.5, rel=1e-9)
    assert found.energy == RelativeOverhead(
        mean=found.energy.mean, low=found.energy.mean, high=found.energy.mean
    )
    assert found.energy.mean == pytest.approx(0.2, rel=1e-9)


def test_nothing_is_known_without_a_pair_that_arrives() -> None:
    lost = {place: GoldenFlight(False, 20.0, 10.0) for place in PLACES}
    with pytest.raises(BadSpecError, match="'finite': no golden flight arrives with and without it, of 4"):
        cost("finite", BARE, lost)
    assert mean_overhead([0.1]) == RelativeOverhead(mean=0.1)


def test_overheads_add_and_so_do_the_squares_of_their_intervals() -> None:
    one, other = (
        RelativeOverhead(mean=0.1, low=0.07, high=0.14),
        RelativeOverhead(mean=0.2, low=0.16, high=0.23),
    )
    model = RelativeOverhead(mean=1.0)
    found = added([one, other], [model])
    assert (found.mean, found.low, found.high) == pytest.approx((1.3, 1.25, 1.35))
    assert added([], []) == RelativeOverhead(mean=0.0, low=0.0, high=0.0)
    unknown = added([one, RelativeOverhead(mean=0.2)], [])
    assert (unknown.low, unknown.high) == (None, None)
    assert unknown.mean == pytest.approx(0.3)


def test_students_interval_covers_the_mean_in_95_of_100() -> None:
    import numpy as np

    draw, held, times = np.random.default_rng(1), 0, 2_000
    for _ in range(times):
        found = mean_overhead(list(draw.normal(0.02, 0.05, 12)))
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 0.02 <= found.high
    assert held / times == pytest.approx(0.95, abs=2.5 * (0.95 * 0.05 / times) ** 0.5)
