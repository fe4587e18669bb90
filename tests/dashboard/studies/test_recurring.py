"""Whether the ranking of places turns when faults recur, from what campaigns kept."""

import pytest

from dashboard.campaigns.spec import campaign_of
from dashboard.studies.ranking import KernelRate, harm_by_place
from dashboard.studies.recurring import sections, turns
from tests.dashboard.studies.test_ranking import runs

ONCE = {"a": KernelRate(5, 100), "b": KernelRate(40, 100), "c": KernelRate(90, 100)}
REVERSED = {"a": KernelRate(90, 100), "b": KernelRate(40, 100), "c": KernelRate(5, 100)}


def test_a_ranking_stays_turns_or_is_left_open() -> None:
    ways = {
        "once": ONCE,
        "intermittent": ONCE,
        "permanent": REVERSED,
        "rate": {name: KernelRate(0, 5) for name in ONCE},
    }
    found = {one.recurrence: one for one in turns({"baseline": ways})}
    assert {name: one.verdict for name, one in found.items()} == {
        "intermittent": "the ranking stays",
        "permanent": "the ranking turns",
        "rate": "not resolved: the interval has 0 in it",
    }
    assert (found["intermittent"].tau, found["permanent"].tau) == pytest.approx((1.0, -1.0))
    assert found["rate"].tau is None


def test_only_places_that_were_struck_in_both_ways_are_ranked() -> None:
    more = {**REVERSED, "d": KernelRate(1, 2)}
    (found,) = turns({"baseline": {"once": ONCE, "permanent": more}})
    assert found.places == 3
    assert turns({"baseline": {"once": ONCE, "permanent": {"a": ONCE["a"], "b": ONCE["b"]}}}) == []
    assert turns({"baseline": {"permanent": REVERSED}}) == []


def test_a_page_tells_it_only_where_faults_recur() -> None:
    assert list(sections({"guarded": {"once": ONCE}})) == []
    page = "\n".join(sections({"guarded": {"once": ONCE, "permanent": REVERSED}}))
    assert "| `c` | 90 (83 to 94) of 100 | 5 (2 to 11) of 100 |" in page
    assert "- permanent: tau -1.00 (" in page
    assert "**the ranking turns**" in page


def test_strikes_are_counted_by_pilot_recurrence_and_place() -> None:
    permanent = {"level": "source", "target": "command.yaw_rate", "recurrence": "permanent"}
    spec = campaign_of(
        {
            "name": "x",
            "runs": 3,
            "arms": [{"name": "bare"}, {"name": "watched", "mission": {"detector": {"scheme": "kinematic"}}}],
            "faults": [
                {"name": "golden"},
                {"name": "pid", "fault": {"target": "pid"}},
                {"name": "yaw", "fault": permanent},
            ],
        }
    )

    found = harm_by_place(
        spec,
        [
            *runs("bare", "golden", None, injection=""),
            *runs("bare", "pid", "lost", "", None),
            *runs("bare", "pid", "lost", injection="not_injected"),
            *runs("bare", "yaw", "", "", "late"),
            *runs("watched", "yaw", "lost"),
        ],
    )
    assert found == {
        "guarded": {"once": {"pid": KernelRate(1, 2)}, "permanent": {"command.yaw_rate": KernelRate(1, 3)}}
    }
