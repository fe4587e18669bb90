"""Predictions agree with what is reckoned by hand, and hold as often as they promise."""

import numpy as np
import pytest
from scipy.special import beta

from dashboard.design.paired_strikes import BARE, PairedStrikes
from dashboard.design.prediction import PlannedStrikes, harm_law, predict
from dashboard.evidence.ledger import StrikeCounts


def planned(harmed: int, struck: int, more: int) -> PlannedStrikes:
    return PlannedStrikes(StrikeCounts(struck, struck, harmed), more)


def test_a_worked_example_agrees_to_nine_digits() -> None:
    # Of 3 in 10, then 2 more: Beta(3.5, 7.5); P(0) = B(3.5, 9.5) / B(3.5, 7.5) = 7.5 * 8.5 / (11 * 12)
    law = harm_law([planned(3, 10, 2)])
    assert law == pytest.approx([63.75 / 132, 2 * 3.5 * 7.5 / 132, 3.5 * 4.5 / 132], rel=1e-9)
    assert law[0] == pytest.approx(beta(3.5, 9.5) / beta(3.5, 7.5), rel=1e-9)
    # And of 0 in 4, then 1: 0.5 / 5. The sum's mean is (2 * 3.5 / 11 + 0.1) / 3.
    found = predict([planned(3, 10, 2), planned(0, 4, 1)])
    assert found.share == pytest.approx((2 * 3.5 / 11 + 0.1) / 3, rel=1e-9)
    assert (found.low, found.high) == (0.0, 2 / 3)
    both = np.convolve(law, [0.9, 0.1])
    assert both.cumsum()[1] < 0.975 < both.cumsum()[2]


def test_of_nothing_everything_is_possible() -> None:
    assert (predict([]).low, predict([]).high) == (0.0, 1.0)
    assert (predict([planned(0, 0, 100)]).low, predict([planned(0, 0, 100)]).high) == (0.0, 1.0)


def test_more_strikes_known_and_more_to_be_made_narrow_the_interval() -> None:
    def width(known: int, more: int) -> float:
        found = predict([planned(known // 5, known, more)])
        return found.high - found.low

    assert width(1000, 100) < width(100, 100)
    assert width(100, 1000) < width(100, 100)
    # Never narrower than what is known: about 2 * 1.96 * sqrt(p q / n).
    assert width(100, 100_000) == pytest.approx(2 * 1.96 * (0.2 * 0.8 / 100) ** 0.5, rel=0.05)


def test_of_five_designs_that_are_flown_95_in_100_lie_inside() -> None:
    """Two elements, three protections of independent effects; each design is flown on strikes of its own."""
    draw = np.random.default_rng(11)
    designs = ((), ("a",), ("b",), ("a", "b"), ("b", "c"))
    times = 300
    inside = np.zeros((times, len(designs)), bool)
    together = np.zeros(times, bool)
    for number in range(times):
        harm = draw.uniform(0.05, 0.6, 2)
        averts = {name: draw.uniform(0.0, 0.95, 2) for name in "abc"}
        strikes = [_strikes(draw, harm[place], {n: p[place] for n, p in averts.items()}) for place in (0, 1)]
        wide = []
        for place, design in enumerate(designs):
            known = [PlannedStrikes(one.counts(design), 80) for one in strikes]
            left = harm * np.prod([1 - averts[name] for name in design], axis=0)
            flown = draw.binomial(80, left).sum() / 160
            found = predict(known)
            inside[number, place] = found.low <= flown <= found.high
            apart = predict(known, 1 - 0.05 / len(designs))
            wide.append(apart.low <= flown <= apart.high)
        together[number] = all(wide)
    assert inside.mean() == pytest.approx(0.96, abs=0.02)
    assert (inside.mean(axis=0) >= 0.95 - 2.6 * (0.95 * 0.05 / times) ** 0.5).all()
    assert together.mean() >= 0.95 - 2 * (0.95 * 0.05 / times) ** 0.5


def _strikes(draw: np.random.Generator, harm: float, averts: dict[str, float]) -> PairedStrikes:
    """Of 120 strikes: what each did bare and with each protection alone."""
    bare = draw.random(120) < harm
    beside = {name: (bare & (draw.random(120) >= part)).astype(np.int8) for name, part in averts.items()}
    count = int(bare.sum())
    return PairedStrikes(StrikeCounts(120, 120, count), {BARE: bare.astype(np.int8), **beside})
