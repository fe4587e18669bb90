"""Whether the kernels that err most alone harm most: rankings, their agreement and its interval."""

from dataclasses import replace

import numpy as np
import pytest

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.spec import Cell, campaign_of
from dashboard.studies.ranking import KernelRate, RankAgreement, agreement, harm_by_kernel
from deploy.errors import BadSpecError
from tests.dashboard.web.components.test_views import record

ALONE = {
    "a": KernelRate(100, 5000),
    "b": KernelRate(500, 5000),
    "c": KernelRate(1000, 5000),
    "d": KernelRate(2000, 5000),
    "e": KernelRate(3000, 5000),
}
SAME = {name: KernelRate(one.found // 10, 500) for name, one in ALONE.items()}
REVERSED = dict(zip(ALONE, reversed(SAME.values()), strict=True))


def test_equal_and_reversed_rankings_are_told_beyond_their_intervals() -> None:
    same, reverse = agreement("baseline", ALONE, SAME), agreement("baseline", ALONE, REVERSED)
    assert (same.tau, reverse.tau) == pytest.approx((1.0, -1.0))
    assert 0 < same.low <= same.high <= 1
    assert -1 <= reverse.low <= reverse.high < 0
    assert same.verdict == "kernels that err more alone harm more"
    assert reverse.verdict == "kernels that err more alone harm less"
    assert [one.kernel for one in same.kernels] == list(ALONE)
    assert same.kernels[0].corrupted_low < 100 / 5000 < same.kernels[0].corrupted_high


def test_a_few_flights_leave_it_open_and_equal_rates_rank_nothing() -> None:
    few = agreement("baseline", ALONE, {name: KernelRate(name == "e", 2) for name in ALONE})
    assert few.low < 0 < few.high
    assert few.verdict.startswith("not resolved")
    none = agreement("baseline", ALONE, {name: KernelRate(0, 100) for name in ALONE})
    assert none.tau is None
    assert none.low < 0 < none.high


def test_only_kernels_of_both_are_ranked_and_the_same_question_has_the_same_answer() -> None:
    flown = {**SAME, "f": KernelRate(1, 2)}
    found = agreement("guarded", {**ALONE, "g": KernelRate(1, 2)}, flown)
    assert found == agreement("guarded", ALONE, SAME)
    assert RankAgreement.model_validate_json(found.model_dump_json()) == found


def test_the_interval_has_the_true_rank_agreement() -> None:
    """Rates whose true tau is 0.6: at least 95 of 100 intervals from drawn counts have it, less the noise."""
    alone, flown = np.array([0.1, 0.2, 0.3, 0.4, 0.5]), np.array([0.1, 0.35, 0.2, 0.5, 0.4])
    generator = np.random.default_rng(11)
    held = 0
    for repetition in range(100):
        one = {str(i): KernelRate(int(generator.binomial(2000, p)), 2000) for i, p in enumerate(alone)}
        other = {str(i): KernelRate(int(generator.binomial(200, p)), 200) for i, p in enumerate(flown)}
        found = agreement("baseline", one, other, seed=repetition)
        held += found.low <= 0.6 <= found.high
    assert held >= 90


@pytest.mark.parametrize(
    ("flown", "message"),
    [
        (
            {"a": KernelRate(1, 2), "b": KernelRate(1, 2)},
            "guarded: 2 kernels were struck both alone and in flight",
        ),
        ({**SAME, "c": KernelRate(0, 0)}, "no fault struck c; strike it more often"),
    ],
)
def test_too_little_is_refused(flown: dict[str, KernelRate], message: str) -> None:
    with pytest.raises(BadSpecError, match=message):
        agreement("guarded", ALONE, flown)


def runs(arm: str, fault: str, *harms: str | None, injection: str = "injected") -> list[FlightRecord]:
    """Flights of an arm with a fault in Sparse: what harmed each."""
    flights = [record(number) for number in range(len(harms))]
    return [
        replace(
            one,
            cell=Cell(arm, "sparse", fault),
            result=replace(one.result, harm=harm, injection=injection) if one.result else None,
        )
        for one, harm in zip(flights, harms, strict=True)
    ]


def test_strikes_of_instructions_are_counted_by_pilot_and_kernel() -> None:
    spec = campaign_of(
        {
            "name": "x",
            "runs": 3,
            "arms": [
                {"name": "baseline", "mission": {"pilot": "baseline"}},
                {"name": "guarded"},
                {"name": "watched", "mission": {"detector": {"scheme": "kinematic"}}},
            ],
            "faults": [
                {"name": "control", "fault": {"target": "pid"}},
                {"name": "way", "fault": {"level": "source", "target": "trajectory.position"}},
            ],
        }
    )

    found = harm_by_kernel(
        spec,
        [
            *runs("baseline", "control", "lost", "", None),
            *runs("baseline", "control", "lost", injection="not_injected"),
            *runs("guarded", "control", "", ""),
            *runs("watched", "control", "lost"),
            *runs("baseline", "way", "lost"),
        ],
    )
    assert found == {"baseline": {"pid": KernelRate(1, 2)}, "guarded": {"pid": KernelRate(0, 2)}}
