"""The ledger agrees with what is reckoned by hand, and its bounds hold as often as they promise."""

import numpy as np
import pytest
import scipy

from dashboard.evidence.budget import Element, Stated, UpsetBudget
from dashboard.evidence.ledger import StrikeCounts, reckon


def exactly(value: float) -> Stated:
    return Stated(value=value, source="by hand")


def about(value: float, factor: float) -> Stated:
    return Stated(value=value, low=value / factor, high=value * factor, source="by hand")


def element(name: str, fit: float, flux: float = 1.0, share: float = 1.0) -> Element:
    return Element(name=name, fit=exactly(fit), flux=exactly(flux), share=exactly(share))


def test_a_worked_example_agrees_to_nine_digits() -> None:
    budget = UpsetBudget(
        name="by hand", elements=(element("a", 700.0, 300.0, 0.25), element("b", 40.0, 300.0))
    )
    ledger = reckon(budget, [StrikeCounts(2000, 900, 60), StrikeCounts(500, 50, 1)])
    # 700e-9 * 300 * 0.25 * 60 / 2000 and 40e-9 * 300 * 1 / 500
    assert ledger.lines[0].rate_per_hour == pytest.approx(1.575e-6, rel=1e-9)
    assert ledger.lines[1].rate_per_hour == pytest.approx(2.4e-8, rel=1e-9)
    assert ledger.rate_per_hour == pytest.approx(1.599e-6, rel=1e-9)
    # Of nothing in 3 strikes the interval ends at 1 - 0.025 ** (1 / 3).
    (line,) = reckon(UpsetBudget(name="c", elements=(element("c", 1.0),)), [StrikeCounts(3, 0, 0)]).lines
    assert line.manifests.high == pytest.approx(1 - 0.025 ** (1 / 3), rel=1e-9)
    assert line.harms == (0.0, 1.0)


def test_the_bound_of_one_line_is_that_of_clopper_and_pearson_of_harm_in_strikes() -> None:
    budget = UpsetBudget(name="one", elements=(element("a", 1e9),), draws=1_000_000)
    ledger = reckon(budget, [StrikeCounts(400, 120, 9)])
    assert ledger.bound_per_hour == pytest.approx(scipy.stats.beta.ppf(0.95, 10, 391), rel=5e-3)


def test_what_is_known_within_a_range_widens_the_bound() -> None:
    counts = [StrikeCounts(100_000, 50_000, 10_000)]
    for factor in (1.5, 3.0):
        one = Element(name="a", fit=about(100.0, factor), flux=exactly(1.0), share=exactly(1.0))
        ledger = reckon(UpsetBudget(name="range", elements=(one,), draws=400_000), counts)
        # 1.645 of the 1.96 deviations that the range goes up
        assert ledger.bound_per_hour == pytest.approx(1e-8 * factor ** (1.644854 / 1.959964), rel=0.01)


def test_bounds_cover_the_truth_in_at_least_95_of_100_campaigns() -> None:
    draw = np.random.default_rng(3)
    elements = tuple(element(name, fit) for name, fit in (("a", 500.0), ("b", 50.0), ("c", 5.0)))
    budget = UpsetBudget(name="known", elements=elements, draws=1_000)
    held, campaigns = 0, 600
    for number in range(campaigns):
        manifest, harm = draw.uniform(0.05, 0.9, 3), draw.uniform(0.0, 0.2, 3)
        manifested = draw.binomial(300, manifest)
        counts = [
            StrikeCounts(300, int(m), int(h))
            for m, h in zip(manifested, draw.binomial(manifested, harm), strict=True)
        ]
        true = sum(one.fit.value / 1e9 * p * q for one, p, q in zip(elements, manifest, harm, strict=True))
        held += reckon(budget, counts, seed=number).bound_per_hour >= true
    assert held / campaigns >= 0.95 - 2 * (0.95 * 0.05 / campaigns) ** 0.5


def test_strikes_without_harm_that_the_claim_still_needs() -> None:
    def needed(target: float | None, struck: int = 100) -> int | None:
        budget = UpsetBudget(name="a", elements=(element("a", 1e9),), target_per_hour=target, draws=20_000)
        return reckon(budget, [StrikeCounts(struck, 0, 0)]).more_strikes

    assert needed(None) is None
    assert needed(0.05) == 0
    # Nothing in n strikes is below 3 / n.
    assert needed(1e-3) == pytest.approx(3000 - 100, rel=0.05)


def test_one_element_more_moves_no_other() -> None:
    few = UpsetBudget(name="a", elements=(element("a", 10.0),), draws=1_000)
    more = few.model_copy(update={"elements": (*few.elements, element("b", 10.0))})
    counts = [StrikeCounts(50, 20, 3), StrikeCounts(60, 10, 1)]
    assert reckon(few, counts[:1]).lines[0] == reckon(more, counts).lines[0]
