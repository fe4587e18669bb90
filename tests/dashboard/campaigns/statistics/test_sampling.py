"""Weighted and stratified estimates, sample sizes, and what a study can tell."""

import numpy as np
import pytest

from dashboard.campaigns.statistics.proportions import wilson
from dashboard.campaigns.statistics.sampling import (
    Stratum,
    flights_to_tell,
    neyman_allocation,
    resolvable_drop,
    sample_size,
    stratified_proportion,
    weighted_proportion,
)


@pytest.mark.parametrize(("margin", "flights"), [(0.05, 384), (0.03, 1067), (0.02, 2401), (0.01, 9604)])
def test_sample_sizes_as_published(margin: float, flights: int) -> None:
    assert sample_size(margin) == flights


def test_a_small_population_needs_fewer() -> None:
    # Krejcie and Morgan 1970: 278 of 1,000, 370 of 10,000
    assert sample_size(0.05, 1000) == 278
    assert sample_size(0.05, 10_000) == 370


def test_a_hundred_flights_cannot_tell_95_from_90() -> None:
    assert flights_to_tell(0.95, 0.90) == pytest.approx(434.4, abs=0.1)  # R: power.prop.test
    assert resolvable_drop(434) == pytest.approx(0.05, abs=1e-4)
    drop = resolvable_drop(100)
    assert drop is not None
    assert drop > 0.1
    assert resolvable_drop(2) is None


def test_equal_weights_change_nothing() -> None:
    outcomes = [True] * 30 + [False] * 10
    estimate = weighted_proportion(outcomes, [2.5] * 40)
    assert estimate.p == pytest.approx(0.75)
    assert estimate.n_eff == pytest.approx(40)
    assert estimate.interval == pytest.approx(wilson(30, 40))


def test_unequal_weights_by_hand() -> None:
    estimate = weighted_proportion([True, False, True], [1.0, 2.0, 3.0])
    assert estimate.p == pytest.approx(4 / 6)
    assert estimate.n_eff == pytest.approx(36 / 14)
    with pytest.raises(ValueError, match="weights"):
        weighted_proportion([True], [-1.0])


def test_strata_by_hand() -> None:
    estimate = stratified_proportion([Stratum(0.3, 5, 10), Stratum(0.7, 16, 20)])
    assert estimate.p == pytest.approx(0.3 * 0.5 + 0.7 * 0.8)
    variance = 0.09 * 0.25 / 10 + 0.49 * 0.16 / 20
    assert estimate.n_eff == pytest.approx(estimate.p * (1 - estimate.p) / variance)
    with pytest.raises(ValueError, match="strata"):
        stratified_proportion([Stratum(1.0, 0, 0)])


def test_a_stratum_without_events_keeps_its_doubt() -> None:
    interval = stratified_proportion([Stratum(0.5, 0, 10), Stratum(0.5, 0, 10)]).interval
    assert interval.low == 0.0
    assert interval.high > 0.1


def test_neyman_gives_flights_to_what_varies() -> None:
    assert neyman_allocation(100, [0.5, 0.5], [0.3, 0.1]) == [75, 25]
    assert neyman_allocation(10, [0.5, 0.5], [0.5, 0.0]) == [9, 1]
    assert sum(neyman_allocation(97, [0.2, 0.3, 0.5], [0.5, 0.4, 0.1])) == 97
    with pytest.raises(ValueError, match="allocation"):
        neyman_allocation(1, [0.5, 0.5], [0.5, 0.5])


def test_the_weighted_interval_covers() -> None:
    draw = np.random.default_rng(3)
    hits = []
    for p in draw.uniform(0.05, 0.95, 4000):
        estimate = weighted_proportion(list(draw.random(120) < p), list(draw.uniform(0.5, 2.0, 120)))
        hits.append(estimate.interval.low <= p <= estimate.interval.high)
    assert 0.94 <= np.mean(hits) <= 0.97


def test_the_stratified_interval_covers() -> None:
    draw = np.random.default_rng(4)
    shares, flights = (0.2, 0.3, 0.5), (60, 60, 120)
    hits = []
    for ps in draw.uniform(0.05, 0.95, (4000, 3)):
        strata = [
            Stratum(share, int(draw.binomial(n, p)), n)
            for share, n, p in zip(shares, flights, ps, strict=True)
        ]
        interval = stratified_proportion(strata).interval
        hits.append(interval.low <= float(np.dot(shares, ps)) <= interval.high)
    assert 0.94 <= np.mean(hits) <= 0.97
