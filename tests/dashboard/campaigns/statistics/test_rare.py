"""The rate of a rare event: unbiased, covered by its interval, and cheaper than uniform draws."""

import numpy as np
import pytest

from dashboard.campaigns.statistics.harm_rates import MOST_STRATA, Counts, expected_rates, grouped
from dashboard.campaigns.statistics.rare import DEFENSIVE, estimate_rare, learned_proposal
from dashboard.campaigns.statistics.sampling import neyman_allocation
from tests.bench.rare import RATE, SYNTHETIC, Population, estimated, repeated, synthetic

NAMES = [("high", "early"), ("high", "late"), ("low", "early"), ("low", "late")]


def test_what_names_have_in_common_is_expected_of_strata_that_were_not_drawn() -> None:
    drawn = np.array([100, 0, 100, 100])
    rates = expected_rates(NAMES, drawn, np.array([40, 0, 0, 0]))
    assert rates[0] == pytest.approx(0.4, abs=0.02)
    assert rates[1] > 3 * rates[3]
    assert (rates > 0).all()
    assert (rates < 1).all()


def test_without_events_all_strata_are_expected_to_be_alike() -> None:
    rates = expected_rates(NAMES, np.full(4, 50), np.zeros(4, np.int64))
    assert rates == pytest.approx(np.full(4, rates[0]), rel=0.01)
    assert 0 < rates[0] < 0.01


def test_own_draws_outweigh_what_names_tell() -> None:
    few, many = (expected_rates(NAMES, np.array([n, 100, 100, 100]), np.zeros(4, np.int64)) for n in (1, 999))
    assert many[0] < few[0] / 100


def test_groups_are_cut_where_the_error_is_least() -> None:
    weights, rates = np.array([0.4, 0.02, 0.5, 0.08]), np.array([1e-4, 0.9, 1e-4, 0.2])
    groups = grouped(weights, rates, 3)
    assert list(groups) == [2, 0, 2, 1]
    assert list(grouped(weights, rates, 2)) == [1, 0, 1, 0]
    with pytest.raises(ValueError, match="fewer respects"):
        grouped(np.ones(MOST_STRATA + 1), np.ones(MOST_STRATA + 1), 2)


def test_a_proposal_keeps_a_part_for_all() -> None:
    weights, rates = np.array([0.9, 0.1]), np.array([1e-9, 0.5])
    proposal = learned_proposal(weights, rates)
    assert proposal.sum() == pytest.approx(1.0)
    assert (weights / proposal).max() <= 1 / DEFENSIVE
    assert proposal[1] > 0.9


def test_all_draws_are_made_and_told() -> None:
    asked: list[Counts] = []

    def strike(counts: Counts) -> Counts:
        asked.append(counts)
        return np.zeros(4, np.int64)

    found = estimate_rare(NAMES, [0.25] * 4, strike, 1000, seed=3)
    assert [int(one.sum()) for one in asked[:1]] == [80]
    assert sum(int(one.sum()) for one in asked) == found.draws == 1000
    assert sum(group.trials for group in found.groups) == int(asked[-1].sum())
    assert sum(group.weight for group in found.groups) == pytest.approx(1.0)
    assert found.p == 0.0
    assert found.interval.low == 0.0
    assert 0.0 < found.interval.high < 0.02
    assert 0.0 < found.n_eff <= 1000


def test_later_batches_go_where_the_event_was_seen() -> None:
    asked: list[Counts] = []

    def strike(counts: Counts) -> Counts:
        asked.append(counts)
        return np.array([counts[0] // 2, 0, 0, 0])

    estimate_rare(NAMES, [0.1, 0.3, 0.3, 0.3], strike, 1000, seed=3)
    pilot, second, *_ = asked
    assert pilot[0] / pilot.sum() < 0.25
    assert second[0] / second.sum() > 0.4


def test_strata_of_a_group_count_by_their_weights() -> None:
    population = Population(
        [(str(one),) for one in range(6)],
        np.array([0.5, 0.02, 0.3, 0.02, 0.15, 0.01]),
        np.array([0.001, 0.02, 0.002, 0.03, 0.004, 0.6]),
    )
    found = repeated(population, 2000, range(300))
    assert abs(found.bias) < 0.02


def test_the_same_seed_estimates_the_same() -> None:
    population = synthetic(0.5, 0.01)
    assert estimated(population, 2000, 5) == estimated(population, 2000, 5)
    assert estimated(population, 2000, 5) != estimated(population, 2000, 6)


def test_neyman_shares_out_the_last_batch() -> None:
    found = estimated(synthetic(0.8, 0.0), 4000, 1)
    assert sum(one.trials for one in found.groups) == 4000 - 800
    hottest = max(found.groups, key=lambda one: one.successes)
    assert hottest.trials > 10 * hottest.weight * 3200
    assert neyman_allocation(10, [1.0, 1.0], [1.0, 1.0]) == [5, 5]


def test_bad_strata_are_refused() -> None:
    def strike(counts: Counts) -> Counts:
        return counts

    with pytest.raises(ValueError, match="strata"):
        estimate_rare([], [], strike, 100, 0)
    with pytest.raises(ValueError, match="strata"):
        estimate_rare(NAMES, [0.5, 0.5, 0.0, 0.0], strike, 100, 0)
    with pytest.raises(ValueError, match="draws"):
        estimate_rare(NAMES, [0.25] * 4, strike, 39, 0)


def test_an_event_that_always_comes_is_certain() -> None:
    found = estimate_rare(NAMES, [0.25] * 4, lambda counts: counts, 400, 0)
    assert found.p == 1.0
    assert found.interval.high == 1.0
    assert found.gain < 1.0


@pytest.mark.parametrize("shape", ["all in a stratum, at 80 %", "1 % elsewhere, the rest at 80 %"])
def test_a_concentrated_event_is_covered_at_a_twentieth_of_the_cost(shape: str) -> None:
    population = synthetic(*SYNTHETIC[shape])
    assert population.rate == pytest.approx(RATE)
    found = repeated(population, 8000, range(200))
    assert 0.92 <= found.coverage <= 1.0
    assert abs(found.bias) < 0.01
    assert found.gain > 20
    assert found.gain < population.limit


@pytest.mark.soak
@pytest.mark.parametrize("shape", list(SYNTHETIC))
def test_intervals_cover_whatever_the_strata(shape: str) -> None:
    found = repeated(synthetic(*SYNTHETIC[shape]), 10000, range(1000))
    assert 0.93 <= found.coverage <= 0.985
    assert abs(found.bias) < 0.02
