"""Harm is what holds in a flight and not in its golden twin; outcomes here are made by hand."""

import numpy as np
import pytest

from deploy.mission.judgement import distance_to_path, judge_harm
from services.models.mission import MissionSpec
from services.models.oracles.harm import HarmSpec
from services.models.oracles.properties import PropertyResult
from services.models.outcome import NO_FLIGHT, Outcome


def flight(*, success: bool, time_s: float = 20.0, margin: float = 1.0) -> Outcome:
    """A flight with one property."""
    near = PropertyResult(
        property="always clearance >= 1", robustness=margin, holds=margin >= 0, at_ns=3_000_000_000
    )
    return Outcome(
        spec=MissionSpec(harm=HarmSpec(time_factor=1.25)),
        result="success" if success else "collision",
        qof=NO_FLIGHT.model_copy(update={"success": success, "flight_time_s": time_s}),
        digest="",
        wall_s=1.0,
        nodes={},
        topics={},
        properties=[near],
    )


def told(flown: Outcome, twin: Outcome) -> list[tuple[str, float]]:
    """Kinds of harm, and when."""
    return [
        (one.kind, one.at_ns / 1e9) for one in judge_harm(flown, twin, round(flown.qof.flight_time_s * 1e9))
    ]


def test_a_lost_or_late_mission_is_harm_where_the_twins_succeeded() -> None:
    arrived, lost = flight(success=True), flight(success=False)
    late, both = flight(success=True, time_s=26.0), flight(success=False, time_s=26.0)
    just = flight(success=True, time_s=25.0)
    assert told(arrived, arrived) == told(lost, lost) == told(late, lost) == told(just, arrived) == []
    assert told(lost, arrived) == [("mission_lost", 20.0)]
    assert told(late, arrived) == [("too_slow", 25.0)]
    assert told(both, arrived) == [("too_slow", 25.0), ("mission_lost", 26.0)]


def test_a_property_that_the_twin_violates_is_no_harm() -> None:
    kept, violated = flight(success=True), flight(success=True, margin=-0.5)
    assert told(violated, kept) == [("property_violated", 3.0)]
    assert told(violated, violated) == told(kept, violated) == []


def test_the_deviation_is_that_from_the_path_not_from_its_points() -> None:
    east = [[float(x), 0.0, 0.0] for x in (0, 0, 1, 2, 3, 4)]
    path = np.array([*east, *([4.0, float(y), 0.0] for y in (1, 2, 3))])
    points = np.array([[2.4, 1.0, 0.0], [4.0, 3.0, 0.0], [5.0, 1.0, 0.0], [4.0, 4.0, 2.0]])
    assert distance_to_path(points, path) == pytest.approx([1.0, 0.0, 1.0, 5.0**0.5])
