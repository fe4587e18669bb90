"""What is asked of each mission is judged by where the vehicle truly is."""

from __future__ import annotations

import numpy as np
import pytest

from services.models.mission import MissionSpec
from sim.mission.area import cells, corners
from sim.mission.objective import TARGET_HEIGHT_M, Objective, objective, target
from sim.world import make_world

WORLD = make_world("sparse", 3)
STILL = np.zeros(3)


class Stand:
    """A vehicle that is where it is put, level, nose to the east."""

    def __init__(self, *position: float) -> None:
        self.position, self.velocity, self.rotation = np.array(position), STILL, np.eye(3)


def of(mission: str, **area: object) -> Objective:
    spec = MissionSpec.model_validate({"mission": mission, "seed": 3, "area": area})
    return objective(spec, WORLD, None if mission == "navigation" else corners(spec.area, WORLD))


def fly(asked: Objective, places: object) -> list[bool]:
    done = []
    for place in places:  # type: ignore[attr-defined]
        asked.observe(Stand(*place))  # type: ignore[arg-type]
        done.append(asked.accomplished)
    return done


def test_navigation_and_delivery_end_where_they_should() -> None:
    start, goal = WORLD.start, WORLD.goal
    assert fly(of("navigation"), [start, goal]) == [False, True]
    assert fly(of("delivery"), [start, goal, (start + goal) / 2, start]) == [False, False, False, True]
    assert of("delivery").coverage is None


def test_a_scan_needs_every_swath() -> None:
    lower, upper = corners(MissionSpec().area, WORLD)
    lanes = [[(x, y, 2.0) for x in np.arange(lower[0], upper[0])] for y in (lower[1] + 4, 0.0, upper[1] - 4)]
    lanes[1] = [(x, (lower[1] + upper[1]) / 2, 2.0) for x in np.arange(lower[0], upper[0])]
    scan = of("scanning")
    assert not any(fly(scan, lanes[0]))
    assert not any(fly(scan, lanes[2]))
    assert scan.coverage == pytest.approx(2 / 3, abs=0.05)
    assert fly(scan, lanes[1])[-1]
    assert not fly(of("scanning", coverage=1.0), lanes[0] + lanes[2])[-1]


def test_a_survey_counts_what_was_in_view() -> None:
    survey = of("mapping")
    fly(survey, [WORLD.start])
    assert survey.coverage is not None
    seen = survey.coverage * len(cells(corners(MissionSpec().area, WORLD), WORLD.obstacles))
    assert 20.0 < seen < 80.0  # a sector of 90 degrees and 10 m has 79 m^2; half of it lies outside
    fly(survey, [WORLD.start])
    assert survey.coverage * len(cells(corners(MissionSpec().area, WORLD), WORLD.obstacles)) == seen


def test_a_search_ends_when_the_target_is_in_view() -> None:
    area = corners(MissionSpec().area, WORLD)
    where = target(3, WORLD, area)
    away = [where + np.array([-11.0, 0.0, 1.0]), where + np.array([5.0, 0.0, 1.0])]
    search = of("search")
    assert fly(search, away) == [False, False]
    assert fly(search, [where + np.array([-2.0, 0.0, 0.5])]) == [True]
    assert fly(search, away) == [True, True]


def test_targets_stand_free_on_the_ground_away_from_the_start_and_by_the_seed() -> None:
    area = corners(MissionSpec().area, WORLD)
    places = [target(seed, WORLD, area) for seed in range(20)]
    assert np.array_equal(places[4], target(4, WORLD, area))
    assert len({tuple(place) for place in places}) > 15
    for place in places:
        assert place[2] == WORLD.bounds[0, 2] + TARGET_HEIGHT_M
        assert (area[0, :2] < place[:2]).all()
        assert (place[:2] < area[1, :2]).all()
        assert np.linalg.norm(place - WORLD.start) > 15.0
