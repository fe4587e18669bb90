"""Against published tables and values checked with R, and coverage by simulation."""

import numpy as np
import pytest
from scipy.stats import binomtest

from dashboard.campaigns.statistics.proportions import (
    Interval,
    Pairs,
    clopper_pearson,
    holm,
    lower_bound,
    mcnemar,
    mid_p,
    newcombe,
    newcombe_paired,
    wilson,
)

HONEST = (0.94, 0.97)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # Newcombe 1998, Stat. Med. 17:857, table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_as_published(successes: int, trials: int, low: float, high: float) -> None:
    assert wilson(successes, trials) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # the same table, method 5
        (81, 263, 0.2527, 0.3676),
        (15, 148, 0.0578, 0.1617),
        (0, 20, 0.0000, 0.1684),
        (1, 29, 0.0009, 0.1776),
    ],
)
def test_clopper_pearson_as_published(successes: int, trials: int, low: float, high: float) -> None:
    assert clopper_pearson(successes, trials) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # the same table, method 6
        (81, 263, 0.2544, 0.3658),
        (15, 148, 0.0601, 0.1581),
        (0, 20, 0.0000, 0.1391),
        (1, 29, 0.0017, 0.1585),
    ],
)
def test_mid_p_as_published(successes: int, trials: int, low: float, high: float) -> None:
    assert mid_p(successes, trials) == pytest.approx((low, high), abs=5e-5)


def test_mid_p_has_both_ends_of_the_range() -> None:
    assert mid_p(0, 0) == (0.0, 1.0)
    assert mid_p(7, 7).high == 1.0
    assert mid_p(7, 7).low == pytest.approx(1.0 - mid_p(0, 7).high)


@pytest.mark.parametrize(("successes", "trials"), [(0, 7), (3, 7), (7, 7), (95, 100)])
def test_wilson_is_scipys(successes: int, trials: int) -> None:
    theirs = binomtest(successes, trials).proportion_ci(method="wilson")
    assert wilson(successes, trials) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_without_trials_everything_is_possible() -> None:
    assert wilson(0, 0) == clopper_pearson(0, 0) == (0.0, 1.0)
    assert newcombe((0, 0), (0, 5)) == newcombe_paired(Pairs(0, 0, 0, 0)) == (-1.0, 1.0)


def test_no_event_in_n_ends_near_three_nths() -> None:
    assert clopper_pearson(0, 300).high * 300 == pytest.approx(3.67, abs=0.01)
    assert clopper_pearson(0, 300, level=0.90).high * 300 == pytest.approx(3.0, abs=0.02)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # Newcombe 1998, Stat. Med. 17:873, table II, method 10
        ((56, 48), (70, 80), 0.0524, 0.3339),
        ((9, 3), (10, 10), 0.1705, 0.8090),
        ((6, 2), (7, 7), 0.0582, 0.8062),
        ((5, 0), (56, 29), -0.0381, 0.1926),
        ((0, 0), (10, 20), -0.1611, 0.2775),
        ((0, 0), (10, 10), -0.2775, 0.2775),
        ((10, 0), (10, 20), 0.6791, 1.0000),
        ((10, 0), (10, 10), 0.6075, 1.0000),
    ],
)
def test_newcombe_as_published(
    successes: tuple[int, int], trials: tuple[int, int], low: float, high: float
) -> None:
    assert newcombe(successes, trials) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(
    ("pairs", "low", "high"),
    [
        # Fagerland, Lydersen and Laake 2014 (contingencytables in R): square-and-add
        (Pairs(1, 1, 7, 12), -0.507, -0.026),
        # Newcombe 1998, Stat. Med. 17:2635, table II, method 10
        (Pairs(36, 12, 2, 0), 0.0569, 0.3404),
        (Pairs(20, 12, 2, 16), 0.0562, 0.3292),
    ],
)
def test_newcombe_paired_as_published(pairs: Pairs, low: float, high: float) -> None:
    assert newcombe_paired(pairs) == pytest.approx((low, high), abs=5e-4)


@pytest.mark.parametrize(
    ("pairs", "p_value"),
    [
        # R: exact2x2::mcnemar.exact
        (Pairs(1, 1, 7, 12), 0.0703125),
        (Pairs(59, 6, 16, 80), 0.0524788),
        (Pairs(40, 0, 0, 3), 1.0),
        (Pairs(0, 5, 0, 0), 0.0625),
    ],
)
def test_exact_mcnemar_as_r(pairs: Pairs, p_value: float) -> None:
    assert mcnemar(pairs) == pytest.approx(p_value, abs=5e-8)


def test_holm_as_r() -> None:
    # R: p.adjust(c(0.01, 0.04, 0.03, 0.005), "holm")
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_pairs_are_counted_in_order() -> None:
    assert Pairs.of([True, True, False, False], [True, False, True, False]) == (1, 1, 1, 1)
    with pytest.raises(ValueError, match="1 outcomes beside 0"):
        Pairs.of([True], [])


def _covers(interval: Interval, truth: float) -> bool:
    return interval.low <= truth <= interval.high


@pytest.mark.parametrize("trials", [20, 100, 300])
def test_wilson_covers(trials: int) -> None:
    draw = np.random.default_rng(trials)
    truths = draw.random(4000)
    hits = [_covers(wilson(int(draw.binomial(trials, p)), trials), p) for p in truths]
    assert HONEST[0] <= np.mean(hits) <= HONEST[1]


@pytest.mark.parametrize("p", [0.02, 0.5, 0.95])
def test_clopper_pearson_never_covers_too_little(p: float) -> None:
    draw = np.random.default_rng(5)
    limits = {x: clopper_pearson(x, 60) for x in range(61)}
    hits = [_covers(limits[int(x)], p) for x in draw.binomial(60, p, 4000)]
    assert np.mean(hits) >= 0.945


@pytest.mark.parametrize("trials", [30, 100])
def test_newcombe_covers(trials: int) -> None:
    draw = np.random.default_rng(trials)
    hits = []
    for p1, p2 in draw.random((4000, 2)):
        x = (int(draw.binomial(trials, p1)), int(draw.binomial(trials, p2)))
        hits.append(_covers(newcombe(x, (trials, trials)), p1 - p2))
    assert HONEST[0] <= np.mean(hits) <= HONEST[1]


@pytest.mark.parametrize("trials", [40, 100])
def test_newcombe_paired_covers(trials: int) -> None:
    draw = np.random.default_rng(trials)
    hits = []
    for cells in draw.dirichlet([2.0, 1.0, 1.0, 2.0], 4000):
        pairs = Pairs(*(int(count) for count in draw.multinomial(trials, cells)))
        hits.append(_covers(newcombe_paired(pairs), cells[1] - cells[2]))
    assert HONEST[0] <= np.mean(hits) <= HONEST[1]


def test_the_bound_of_a_claim_is_one_sided() -> None:
    assert lower_bound(300, 300, 0.95) == pytest.approx(0.05 ** (1 / 300))
    assert lower_bound(300, 300, 0.99) == pytest.approx(0.01 ** (1 / 300))
    assert lower_bound(0, 300, 0.95) == 0.0
    assert lower_bound(8, 10, 0.95) == pytest.approx(0.4931, abs=5e-5)
