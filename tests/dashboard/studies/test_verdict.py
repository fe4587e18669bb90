"""What is confirmed of the paper and what few flights cannot tell."""

import pytest

from dashboard.campaigns.statistics.proportions import Interval
from dashboard.studies.paper import PaperValue
from dashboard.studies.verdict import in_words, judge


def value(paper: float, ours: float | None, between: Interval | None, without: float | None) -> PaperValue:
    return PaperValue("success", "%", paper, lambda _: ours, lambda _: between, lambda _: without)


@pytest.mark.parametrize(
    ("low", "high", "without", "verdict"),
    [
        (85.0, 95.0, 100.0, "confirmed"),
        (85.0, 95.0, None, "confirmed"),
        (85.0, 100.0, 100.0, "not resolved"),
        (96.0, 100.0, 100.0, "not confirmed"),
        (92.0, 92.0, 100.0, "confirmed"),
    ],
)
def test_a_number_is_confirmed_if_the_interval_has_it_and_not_that_of_no_effect(
    low: float, high: float, without: float | None, verdict: str
) -> None:
    found = judge(value(92.0, (low + high) / 2, Interval(low, high), without), [])
    assert found.verdict == verdict


def test_without_an_interval_or_flights_nothing_is_claimed() -> None:
    assert judge(value(92.0, 92.0, None, 100.0), []).verdict == "no interval"
    assert judge(value(92.0, None, None, 100.0), []).verdict == "not flown"


def test_each_verdict_is_a_sentence_that_names_the_numbers() -> None:
    found = [judge(value(92.0, 90.0, Interval(85.0, 95.0), 100.0), []) for _ in range(2)]
    told = in_words([*found, judge(value(92.0, None, None, None), [])])
    assert told.splitlines()[0].startswith("**Confirmed** (our interval has the paper's value")
    assert told.splitlines()[0].endswith(": success; success.")
    assert "**Not flown**" in told
    assert "resolved" not in told
