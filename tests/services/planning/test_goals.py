"""Each mission's goal logic by itself: which place comes next."""

from copy import copy

import numpy as np
import pytest
from numpy.typing import NDArray

from services.bus.arrays import FlightPlace
from services.bus.octomaps import MalformedMap
from services.planning.goals import GoalContext, Goals, goals
from tests.services.planning.maps import RESOLUTION_M, box, payload, tree

START, GOAL = np.array([-25.0, 5.0, 2.0]), np.array([25.0, 5.0, 2.0])
PLACE = FlightPlace(GOAL, START, np.array([-25.0, -19.0, 2.0]), np.array([25.0, 5.0, 2.0]))


def ask(aims: Goals, position: NDArray[np.float64], *, reached: bool) -> list[float] | None:
    goal = aims.next(GoalContext(position, reached))
    return None if goal is None else list(goal)


def test_navigation_knows_one_goal() -> None:
    aims = goals("navigation", PLACE, 8.0)
    for reached in (False, True, False):
        assert ask(aims, START, reached=reached) == list(GOAL)


def test_a_delivery_goes_to_the_goal_and_back_and_gives_neither_up() -> None:
    aims = goals("delivery", PLACE, 8.0)
    answers = [ask(aims, START, reached=reached) for reached in (False, False, True, False, True)]
    assert answers == [list(GOAL), list(GOAL), list(START), list(START), list(START)]


def swept(aims: Goals, position: NDArray[np.float64], count: int) -> list[tuple[float, float]]:
    """The next goals (x, y), every second one unreachable."""
    found = []
    for turn in range(count):
        goal = aims.next(GoalContext(position, reached=turn % 2 == 1))
        assert goal is not None
        found.append((float(goal[0]), float(goal[1])))
        position = goal
    return found


def test_a_sweep_begins_at_the_nearest_end_and_passes_over_what_it_cannot_reach() -> None:
    lanes = swept(goals("scanning", PLACE, 10.0), START, 8)
    assert lanes[:6] == [(-25, 1), (25, 1), (25, -7), (-25, -7), (-25, -15), (25, -15)]
    assert lanes[6:] == lanes[:2]  # and over again


def test_a_sweep_that_is_begun_in_the_middle_goes_on_from_there_and_leaves_no_lane_out() -> None:
    lanes = swept(goals("scanning", PLACE, 10.0), np.array([24.0, -7.5, 2.0]), 8)
    assert lanes == [(25, -7), (-25, -7), (-25, -15), (25, -15), (-25, 1), (25, 1), (25, -7), (-25, -7)]


def test_only_the_choice_of_a_goal_runs_a_kernel() -> None:
    assert not goals("navigation", PLACE, 8.0).chooses
    sweep = goals("scanning", PLACE, 8.0)
    assert sweep.chooses
    sweep.next(GoalContext(START, reached=False))
    assert not sweep.chooses


@pytest.mark.parametrize("mission", ["mapping", "search"])
def test_an_exploration_goes_on_until_there_is_no_frontier_left(mission: str) -> None:
    aims = goals(mission, PLACE, 8.0)
    octomap = payload(tree(np.empty((0, 3)), box((-25.0, -19.0, 1.0), (0.0, 5.0, 3.0))))
    position, visited = np.array([-20.0, 0.0, 2.0]), []
    for turn in range(40):
        aims.look(position, octomap, RESOLUTION_M)
        goal = aims.next(GoalContext(position, reached=turn % 2 == 1))
        if goal is None:
            break
        visited.append(goal)
        assert goal[0] == pytest.approx(-0.25)
    assert 1 < len(visited) < 40
    assert goal is None


def test_a_broken_map_is_told() -> None:
    with pytest.raises(MalformedMap):
        goals("mapping", PLACE, 8.0).look(START, b"\x03", RESOLUTION_M)


@pytest.mark.parametrize("mission", ["navigation", "delivery", "scanning", "mapping"])
def test_a_copy_chooses_by_itself_and_what_the_kernel_decided_is_told(mission: str) -> None:
    """Re-execution has a copy choose first, and chooses again from what was before."""
    before = goals(mission, PLACE, 8.0)
    octomap = payload(tree(np.empty((0, 3)), box((-25.0, -19.0, 1.0), (0.0, 5.0, 3.0))))
    before.look(START, octomap, RESOLUTION_M)
    first, second = copy(before), copy(before)
    told = before.decided()
    found = [ask(one, START, reached=True) for one in (first, second)]
    assert found[0] == found[1]
    assert first.decided() == second.decided()
    assert before.decided() == told
    assert (first.decided() != told) == before.chooses
