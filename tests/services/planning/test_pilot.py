"""Planning happens when it must, from the right state, and ends when it is hopeless."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.bus.arrays import Verdict
from services.models.mission import MissionSpec
from services.models.pilots import ALL_GUARDS, Pace
from services.models.safety import BRAKE_BELOW_S
from services.planning.pilot import FAILURES_MAX, GOAL_FAILURES_MAX, Navigator, PlanRequest, Tactics, tactics
from services.planning.voxels import CLOSE, NEAR

HERE, GOAL = np.array([0.0, 0.0, 3.0]), np.array([50.0, 0.0, 3.0])
FAST, STILL = np.array([3.0, 0.0, 0.0]), np.zeros(3)
LATENCY_S = 0.1


def eastwards(start_s: float, duration_s: float = 15.0) -> NDArray[np.float64]:
    t = np.arange(0.0, duration_s + 0.1, 0.25)
    rows = np.zeros((len(t), 12))
    rows[:, 0] = start_s + t
    rows[:, 1] = 3.0 * t
    rows[:, 3] = 3.0
    rows[:, 4] = 3.0
    return rows


def at(t: float) -> NDArray[np.float64]:
    """Where the trajectory of ``flying`` has the vehicle."""
    return np.array([3.0 * (t - 1.0), 0.0, 3.0])


def consider(
    navigator: Navigator,
    now_s: float,
    position: NDArray[np.float64],
    verdict: Verdict,
    velocity: NDArray[np.float64] = FAST,
) -> PlanRequest | None:
    return navigator.consider(now_s, position, velocity, 0.0, verdict)


def asked(
    navigator: Navigator, now_s: float, position: NDArray[np.float64], seq: int, fcs: int = 0
) -> PlanRequest:
    """A request from a standstill that must come."""
    request = consider(navigator, now_s, position, Verdict(now_s, seq, fcs, math.inf), STILL)
    assert request is not None
    return request


@pytest.fixture
def flying() -> Navigator:
    """On its way with trajectory 1 since t = 1."""
    navigator = Navigator(GOAL, LATENCY_S, Tactics())
    request = asked(navigator, 0.5, HERE, 0)
    assert (request.trajectory_seq, request.future_collision_seq, request.limit) == (1, 0, NEAR)
    answer = navigator.answer(request, eastwards(1.0))
    assert (answer.trajectory_seq, answer.failed) == (1, False)
    return navigator


def test_a_free_way_is_flown_without_another_plan(flying: Navigator) -> None:
    for t in np.arange(1.0, 15.0, 0.3):
        assert consider(flying, t, at(t), Verdict(t, 1, 0, math.inf)) is None


def test_a_far_collision_is_answered_in_flight(flying: Navigator) -> None:
    request = consider(flying, 3.0, at(3.0), Verdict(2.9, 1, 1, BRAKE_BELOW_S + 1.0))
    assert request is not None
    assert (request.trajectory_seq, request.future_collision_seq) == (2, 1)
    assert 3.0 + LATENCY_S <= request.departure.time_s <= 3.0 + LATENCY_S + 0.25
    assert request.departure.position == pytest.approx(at(request.departure.time_s))
    assert request.departure.velocity == pytest.approx(FAST)


def test_a_near_collision_is_answered_from_where_the_vehicle_will_have_stopped(flying: Navigator) -> None:
    request = consider(flying, 3.0, at(3.0), Verdict(2.9, 1, 1, 0.5))
    assert request is not None
    assert request.departure.time_s == pytest.approx(3.75)
    assert request.departure.position == pytest.approx(at(3.0) + np.array([1.125, 0.0, 0.0]))
    assert not request.departure.velocity.any()


def test_a_verdict_on_an_older_trajectory_is_no_reason(flying: Navigator) -> None:
    request = consider(flying, 3.0, at(3.0), Verdict(2.9, 1, 1, 5.0))
    assert request is not None
    flying.answer(request, eastwards(1.0))
    assert consider(flying, 3.3, at(3.3), Verdict(3.2, 1, 1, 4.7)) is None
    assert consider(flying, 3.6, at(3.6), Verdict(3.5, 2, 1, 4.4)) is not None


def test_a_collision_that_control_may_have_heard_of_needs_a_newer_trajectory(flying: Navigator) -> None:
    assert consider(flying, 3.0, at(3.0), Verdict(2.9, 1, 1, math.inf)) is not None


def test_a_vehicle_that_strayed_gets_a_new_trajectory(flying: Navigator) -> None:
    assert consider(flying, 3.0, at(3.0) + np.array([0.0, 1.5, 0.0]), Verdict(2.9, 1, 0, math.inf)) is None
    request = consider(flying, 3.0, at(3.0) + np.array([0.0, 4.0, 0.0]), Verdict(2.9, 1, 0, math.inf))
    assert request is not None
    assert request.departure.position[1] == pytest.approx(4.0)


def test_a_trajectory_that_is_no_number_is_replaced() -> None:
    navigator = Navigator(GOAL, LATENCY_S, Tactics())
    navigator.answer(asked(navigator, 0.5, HERE, 0), np.full((40, 12), math.nan))
    assert consider(navigator, 3.0, at(3.0), Verdict(2.9, 1, 0, math.inf)) is not None


def test_the_count_of_trajectories_stays_in_its_field() -> None:
    last = 2**32 - 1
    assert asked(Navigator(GOAL, LATENCY_S, Tactics()), 0.5, HERE, last, fcs=last).trajectory_seq == last


def test_a_trajectory_that_ended_short_of_the_goal_is_followed_by_another(flying: Navigator) -> None:
    verdict = Verdict(16.4, 1, 0, math.inf)
    assert consider(flying, 16.5, at(16.0), verdict, STILL) is not None
    assert consider(flying, 16.5, GOAL + 0.2, verdict, STILL) is None


def test_restarted_in_flight_it_plans_at_once_and_goes_on_counting() -> None:
    navigator = Navigator(GOAL, LATENCY_S, Tactics())
    request = consider(navigator, 30.0, at(6.0), Verdict(29.9, 5, 3, math.inf))
    assert request is not None
    assert (request.trajectory_seq, request.future_collision_seq) == (6, 3)
    assert request.departure.position == pytest.approx(at(6.0) + np.array([1.125, 0.0, 0.0]))


def test_the_vehicle_stops_when_there_is_no_path(flying: Navigator) -> None:
    request = consider(flying, 3.0, at(3.0), Verdict(2.9, 1, 1, 4.0))
    assert request is not None
    answer = flying.answer(request, None)
    assert (answer.trajectory_seq, len(answer.points), answer.failed) == (2, 0, False)


def test_without_a_path_it_squeezes_then_retreats_and_tries_again(flying: Navigator) -> None:
    for t in np.arange(1.0, 6.0, 0.3):
        consider(flying, t, at(t), Verdict(t, 1, 0, math.inf))
    attempts = []
    for attempt in range(5):
        request = asked(flying, 6.0 + attempt, at(6.0), 1, fcs=1)
        attempts.append((bool(request.departure.velocity.any()), request.limit, request.retreat))
        flying.answer(request, None)
    assert attempts == [
        (True, NEAR, False),  # in flight
        (False, NEAR, False),
        (False, CLOSE, False),
        (False, CLOSE, True),
        (False, NEAR, False),
    ]


def test_a_retreat_leads_back_along_the_way_and_then_to_the_goal(flying: Navigator) -> None:
    for t in np.arange(1.0, 6.0, 0.3):
        consider(flying, t, at(t), Verdict(t, 1, 0, math.inf))
    for attempt in range(3):
        flying.answer(asked(flying, 6.0 + attempt, at(6.0), 1, fcs=1), None)
    retreat = asked(flying, 9.0, at(6.0), 1, fcs=1)
    assert retreat.retreat
    assert 3.0 < at(6.0)[0] - retreat.goal[0] < 7.0
    flying.answer(retreat, eastwards(9.0, 2.0))
    assert consider(flying, 10.0, np.array([3.0, 0.0, 3.0]), Verdict(10.0, 5, 1, math.inf), STILL) is None
    again = asked(flying, 12.0, retreat.goal, 5, fcs=1)
    assert again.goal == pytest.approx(GOAL)
    assert again.limit == NEAR


def test_the_mission_is_given_up_after_too_many_failures_in_a_row() -> None:
    navigator = Navigator(GOAL, LATENCY_S, Tactics())
    answers = [navigator.answer(asked(navigator, t, HERE, 0), None) for t in range(FAILURES_MAX + 1)]
    assert [answer.failed for answer in answers] == [False] * FAILURES_MAX + [True]


def test_a_path_to_the_goal_ends_the_row_of_failures() -> None:
    navigator = Navigator(GOAL, LATENCY_S, Tactics())
    for t in range(FAILURES_MAX):
        navigator.answer(asked(navigator, t, HERE, 0), None)
    navigator.answer(asked(navigator, 50.0, HERE, 0), eastwards(50.0))
    assert not navigator.answer(asked(navigator, 90.0, HERE, 0), None).failed


def test_the_box_to_search_holds_start_and_goal_and_the_allowed_heights() -> None:
    low, high = asked(Navigator(GOAL, LATENCY_S, Tactics()), 0.5, HERE, 0).box()
    assert (low[:2] < HERE[:2]).all()
    assert (high[:2] > GOAL[:2]).all()
    assert (low[2], high[2]) == (1.0, 10.0)


def test_a_goal_is_reached_at_the_end_of_its_trajectory_and_missed_where_that_ends_elsewhere() -> None:
    navigator = Navigator(at(16.0), LATENCY_S, Tactics())
    assert navigator.arrival(0.5, HERE) is None
    navigator.answer(asked(navigator, 0.5, HERE, 0), eastwards(1.0))
    assert navigator.arrival(9.0, at(9.0)) is None
    assert navigator.arrival(16.1, at(16.0) + 0.2) is True
    short = Navigator(GOAL, LATENCY_S, Tactics())
    short.answer(asked(short, 0.5, HERE, 0), eastwards(1.0))
    assert short.arrival(16.1, at(16.0)) is False
    assert short.arrival(16.1, at(13.0)) is None  # strayed: planned anew, not given up


def test_a_goal_is_given_up_after_some_failures_and_the_next_is_planned_to_at_once() -> None:
    navigator = Navigator(GOAL, LATENCY_S, Tactics())
    for t in range(GOAL_FAILURES_MAX):
        assert navigator.arrival(t, HERE) is None
        assert not navigator.answer(asked(navigator, t, HERE, 0), None).failed
    assert navigator.arrival(50.0, HERE) is False
    navigator.head_for(-GOAL)
    assert navigator.arrival(50.0, HERE) is None
    request = asked(navigator, 50.0, HERE, GOAL_FAILURES_MAX)
    assert list(request.goal) == list(-GOAL)
    assert (request.limit, request.retreat) == (NEAR, False)


def test_the_next_goal_is_planned_to_from_where_the_last_was_reached() -> None:
    navigator = Navigator(at(16.0), LATENCY_S, Tactics())
    navigator.answer(asked(navigator, 0.5, HERE, 0), eastwards(1.0))
    verdict = Verdict(16.0, 1, 0, math.inf)
    assert consider(navigator, 16.1, at(16.0), verdict, STILL) is None
    navigator.head_for(HERE)
    request = consider(navigator, 16.1, at(16.0), verdict, STILL)
    assert request is not None
    assert list(request.goal) == list(HERE)
    assert list(request.departure.position) == list(at(16.0))


BASELINE = tactics(
    MissionSpec(pilot="baseline", pace=Pace(take_off_s=2.0, look_round_s=4.0, plan_wait_s=3.0))
)


def test_the_baseline_hovers_and_looks_round_before_its_first_plan() -> None:
    navigator = Navigator(GOAL, LATENCY_S, BASELINE)
    opening = navigator.opening(0.5, HERE, 1.0, Verdict(0.5, 0, 0, math.inf))
    assert opening is not None
    assert (opening.trajectory_seq, len(opening.points)) == (0, 10)
    assert opening.points[[0, -1], 0].tolist() == [0.5, 6.5]
    assert (opening.points[:, 1:4] == HERE).all()
    assert np.ptp(np.unwrap(opening.points[:, 10])) == pytest.approx(math.tau)
    assert navigator.opening(0.6, HERE, 1.0, Verdict(0.5, 0, 0, math.inf)) is None
    assert consider(navigator, 6.0, HERE, Verdict(6.0, 0, 0, math.inf), STILL) is None


def test_a_baseline_that_is_started_again_in_flight_does_not_look_round() -> None:
    navigator = Navigator(GOAL, LATENCY_S, BASELINE)
    assert navigator.opening(9.0, HERE, 1.0, Verdict(9.0, 3, 0, math.inf)) is None


def test_the_baseline_plans_when_it_has_stood_for_a_while() -> None:
    navigator = Navigator(GOAL, LATENCY_S, BASELINE)
    collides = Verdict(9.0, 1, 1, 3.0)
    assert consider(navigator, 9.0, HERE, collides, FAST) is None
    assert consider(navigator, 10.0, HERE, collides, STILL) is None
    assert consider(navigator, 12.0, HERE, collides, FAST) is None  # pushed on: it begins anew
    assert consider(navigator, 13.0, HERE, collides, STILL) is None
    request = consider(navigator, 16.0, HERE, collides, STILL)
    assert request is not None
    assert not request.departure.velocity.any()


def test_the_baseline_waits_anew_after_a_plan_that_failed() -> None:
    navigator = Navigator(GOAL, LATENCY_S, BASELINE)
    collides = Verdict(9.0, 1, 1, 3.0)
    assert consider(navigator, 9.0, HERE, collides, STILL) is None
    request = consider(navigator, 12.0, HERE, collides, STILL)
    assert request is not None
    navigator.answer(request, None)
    assert consider(navigator, 12.5, HERE, collides, STILL) is None
    assert consider(navigator, 15.4, HERE, collides, STILL) is None
    assert consider(navigator, 15.5, HERE, collides, STILL) is not None


def test_without_their_guards_it_does_not_mind_where_it_is_and_what_was_not_counted() -> None:
    for guards, minds in ((ALL_GUARDS, True), (ALL_GUARDS - {"strayed", "recheck"}, False)):
        navigator = Navigator(GOAL, LATENCY_S, Tactics(guards=guards))
        navigator.answer(asked(navigator, 0.5, HERE, 0), eastwards(1.0))
        strayed = at(3.0) + np.array([0.0, 4.0, 0.0])
        assert (consider(navigator, 3.0, strayed, Verdict(3.0, 1, 0, math.inf)) is not None) is minds
        assert navigator.acted["strayed"] == minds
        assert (consider(navigator, 3.0, at(3.0), Verdict(3.0, 2 - minds, 0, 3.0)) is not None) is False


def test_without_squeeze_it_retreats_when_there_is_no_way() -> None:
    for guards, retreats in ((ALL_GUARDS, False), (ALL_GUARDS - {"squeeze"}, True)):
        navigator = Navigator(GOAL, LATENCY_S, Tactics(guards=guards))
        for x in (0.0, 2.0, 4.0):
            request = asked(navigator, 0.5, np.array([x, 0.0, 3.0]), 0)
        navigator.answer(request, None)
        again = asked(navigator, 1.0, np.array([6.0, 0.0, 3.0]), 0)
        assert (again.limit, again.retreat) == (CLOSE, retreats)
        assert navigator.acted["squeeze"] == (not retreats)
