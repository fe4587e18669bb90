"""The page says what was found in words, escapes what others told, and needs nothing else."""

import html
import re

import pytest

from dashboard.evidence import report
from dashboard.evidence.budget import Element, Stated, UpsetBudget
from dashboard.evidence.evidence import Evidence, HarmfulStrike, LineEvidence, Margin
from dashboard.evidence.scope import ASSUMPTIONS, NEVER_STRUCK

SOURCE = "<script>alert('source')</script>"


def evidence(bound: float, more: int | None, target: float | None = 1e-6) -> Evidence:
    known = Stated(value=20.0, low=5.0, high=80.0, source=SOURCE)
    budget = UpsetBudget(
        name="delivery", elements=(Element(name="control", fit=known, flux=known, share=PART),)
    )
    line = LineEvidence(
        element="control",
        struck=30,
        manifested=20,
        manifests_low=0.5,
        manifests_high=0.8,
        harmed=2,
        harms_low=0.01,
        harms_high=0.3,
        not_injected=0,
        failed=0,
        not_judged=0,
        rate_per_hour=bound / 3,
        bound_per_hour=bound,
    )
    fault = HarmfulStrike(
        element="control",
        rate_per_hour=1e-9,
        struck="pid",
        site="pid_step mulsd xmm0 bit 62",
        seed=3,
        harm=["mission_lost"],
        margin_s=1.25,
        digest="d",
        replay="zenfi replay flown-1/3",
    )
    return Evidence(
        name="delivery",
        zenfi="1",
        confidence=0.95,
        target_per_hour=target,
        rate_per_hour=bound / 3,
        bound_per_hour=bound,
        more_strikes=more,
        budget=budget,
        lines=[line],
        margins=[
            Margin(
                element="control",
                faults=2,
                shortest_s=1.25,
                median_s=2.0,
                median_low_s=None,
                median_high_s=None,
            )
        ],
        dominant=[fault],
        coverage=[],
        campaigns=[],
        assumptions=["<b>Registers</b> have no parity.", *ASSUMPTIONS],
        never_struck=list(NEVER_STRUCK),
    )


PART = Stated(value=0.5, source="measured")


@pytest.mark.parametrize(
    ("bound", "more", "target", "told"),
    [
        (3e-7, 0, 1e-6, ("3e-07 failures", "The bound meets the target of 1e-06", "No more flights")),
        (3e-6, 5000, 1e-6, ("does not meet the target", "needs 5,000 more strikes")),
        (3e-6, None, 1e-6, ("does not meet the target", "No number of further strikes")),
        (3e-6, None, None, ("3e-06 failures", "names no target")),
    ],
)
def test_the_claim_is_told_in_words(
    bound: float, more: int | None, target: float | None, told: tuple[str, ...]
) -> None:
    page = report.page(evidence(bound, more, target))
    for one in told:
        assert one in page


def test_the_page_loads_nothing_and_runs_nothing() -> None:
    page = report.page(evidence(3e-7, 0))
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert not re.search(r"(src|href)=\"(?!#)", page)
    assert "<svg" in page


def test_what_dominates_has_its_command_and_no_compliance_is_claimed() -> None:
    page = report.page(evidence(3e-7, 0))
    assert "zenfi replay flown-1/3" in page
    assert "20/30 (50 to 80 %)" in page
    assert "20 (5 to 80)" in page
    assert "claims no compliance" in page


def test_what_is_assumed_and_what_is_never_struck_stands_on_the_page_and_in_the_data() -> None:
    found = evidence(3e-7, 0)
    page, read = html.unescape(report.page(found)), Evidence.model_validate_json(found.model_dump_json())
    assert "<b>Registers" not in report.page(found)
    for told in (
        *read.assumptions,
        *(text for one in read.never_struck for text in one.model_dump().values()),
    ):
        assert f">{told}<" in page
    assert len(read.assumptions) == 5
