"""Against an independent implementation, to nine digits, over tables that nobody chose."""

import numpy as np
import pytest
from statsmodels.stats import contingency_tables, multitest, proportion

from dashboard.campaigns.statistics.proportions import (
    Pairs,
    clopper_pearson,
    holm,
    mcnemar,
    newcombe,
    wilson,
)
from dashboard.campaigns.statistics.sampling import Stratum, flights_to_tell, stratified_proportion

draw = np.random.default_rng(20)
TRIALS = [int(n) for n in draw.integers(1, 2000, 60)]
SUCCESSES = [int(draw.integers(0, n + 1)) for n in TRIALS]


@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_intervals_of_one_proportion(level: float) -> None:
    for x, n in zip(SUCCESSES, TRIALS, strict=True):
        theirs = proportion.proportion_confint(x, n, 1 - level, "wilson")
        assert wilson(x, n, level) == pytest.approx(np.clip(theirs, 0, 1), rel=0.0, abs=1e-9)
        assert clopper_pearson(x, n, level) == pytest.approx(
            proportion.proportion_confint(x, n, 1 - level, "beta"), rel=0.0, abs=1e-9
        )


def test_interval_of_a_difference() -> None:
    for a, b in zip(range(30), range(30, 60), strict=True):
        x, n = (SUCCESSES[a], SUCCESSES[b]), (TRIALS[a], TRIALS[b])
        theirs = proportion.confint_proportions_2indep(x[0], n[0], x[1], n[1], method="newcomb")
        assert newcombe(x, n) == pytest.approx(theirs, rel=0.0, abs=1e-9)


def test_exact_mcnemar() -> None:
    for cells in draw.integers(0, 40, (60, 4)).tolist():
        theirs = contingency_tables.mcnemar([cells[:2], cells[2:]], exact=True).pvalue
        assert mcnemar(Pairs(*cells)) == pytest.approx(theirs, rel=0.0, abs=1e-9)


def test_holm() -> None:
    for count in (1, 2, 7, 40):
        p_values = draw.random(count) ** 3
        assert holm(list(p_values)) == pytest.approx(
            multitest.multipletests(p_values, method="holm")[1], rel=0.0, abs=1e-9
        )


def test_flights_to_tell_two_rates() -> None:
    for p1, p2 in draw.uniform(0.05, 0.95, (40, 2)).tolist():
        theirs = proportion.power_proportions_2indep(
            p2 - p1, p1, flights_to_tell(p1, p2), alpha=0.05, return_results=False
        )
        assert theirs == pytest.approx(0.8, abs=1e-4)


def test_a_single_stratum_is_a_proportion() -> None:
    for x, n in zip(SUCCESSES, TRIALS, strict=True):
        assert stratified_proportion([Stratum(3.0, x, n)]).interval == pytest.approx(
            wilson(x, n), rel=0.0, abs=1e-9
        )
