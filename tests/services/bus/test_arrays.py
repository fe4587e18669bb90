"""What a stage works with was checked where it came in."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from services.bus.arrays import (
    FARTHEST_M,
    FASTEST_M_S,
    POINTS_MAX,
    Plan,
    inverse,
    plan,
    plan_message,
    quaternion,
    rotated,
    sound_goal,
    state,
    vector,
    verdict,
)
from services.bus.arrays import point as point_message
from services.bus.message_checks import ALL_CHECKS, CheckName, RefusedMessageError
from services.bus.messages import (
    CollisionCheck,
    Goal,
    MalformedMessageError,
    Odometry,
    Pose,
    PoseWithCovariance,
    Twist,
    TwistWithCovariance,
    decode,
    encode,
    header,
)
from services.bus.topics import TOPICS

NONSENSE = [math.nan, math.inf, -math.inf]
HERE, MOVING, AHEAD = np.array([1.0, 2, 3]), np.array([3.0, 0, 0]), np.array([1.0, 0, 0, 0])


def odometry(
    position: NDArray[np.float64] = HERE,
    velocity: NDArray[np.float64] = MOVING,
    attitude: NDArray[np.float64] = AHEAD,
) -> Odometry:
    covariance = np.zeros(36)
    pose = Pose(position=point_message(position), orientation=quaternion(attitude))
    twist = Twist(linear=vector(velocity), angular=vector(np.zeros(3)))
    return Odometry(
        header(0, "map"), "body", PoseWithCovariance(pose, covariance), TwistWithCovariance(twist, covariance)
    )


def rows(count: int) -> NDArray[np.float64]:
    points = np.zeros((count, 12))
    points[:, 0] = np.arange(count) * 0.25
    return points


def received(points: NDArray[np.float64]) -> Plan:
    message = plan_message(header(0, "map"), Plan(3, 2, points, failed=False))
    return plan(decode(encode(message, TOPICS["trajectory"].type), TOPICS["trajectory"].type))


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("nonsense", [*NONSENSE, 1e300, 1.01 * FARTHEST_M])
def test_a_position_or_velocity_out_of_this_world_is_refused(axis: int, nonsense: float) -> None:
    bad = HERE.copy()
    bad[axis] = nonsense
    assert state(odometry()).velocity == pytest.approx(MOVING)
    with pytest.raises(MalformedMessageError, match="odometry"):
        state(odometry(position=bad))
    with pytest.raises(MalformedMessageError, match="odometry"):
        state(odometry(velocity=bad))
    assert FASTEST_M_S < FARTHEST_M


SPEEDS = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)
ROTATIONS = st.tuples(*[st.floats(-1, 1)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(SPEEDS, ROTATIONS)
def test_the_twist_of_odometry_is_in_the_body_frame_and_the_state_in_the_world_frame(
    body: NDArray[np.float64], rotation: NDArray[np.float64]
) -> None:
    attitude = rotation / np.linalg.norm(rotation)
    world = state(odometry(velocity=body, attitude=attitude)).velocity
    assert world == pytest.approx(Rotation.from_quat(attitude[[1, 2, 3, 0]]).apply(body), abs=1e-12)
    assert rotated(world, inverse(attitude)) == pytest.approx(body, abs=1e-12)


@pytest.mark.parametrize("attitude", [[0.0, 0, 0, 0], [math.nan, 0, 0, 0], [1.0, 1, 0, 0], [1e200, 0, 0, 0]])
def test_what_is_no_rotation_is_refused(attitude: list[float]) -> None:
    with pytest.raises(MalformedMessageError, match="odometry"):
        state(odometry(attitude=np.array(attitude)))


def test_a_trajectory_may_be_empty_and_long() -> None:
    assert received(rows(0)).points.shape == (0, 12)
    assert np.array_equal(received(rows(POINTS_MAX)).points, rows(POINTS_MAX))


def test_a_trajectory_of_parts_of_points_or_far_too_many_is_refused() -> None:
    for points in (rows(POINTS_MAX + 1), np.zeros(13), np.zeros(1)):
        with pytest.raises(MalformedMessageError, match="trajectory"):
            received(points)


@pytest.mark.parametrize("nonsense", NONSENSE)
@pytest.mark.parametrize("column", range(12))
def test_a_trajectory_that_is_not_finite_is_refused(nonsense: float, column: int) -> None:
    points = rows(9)
    points[4, column] = nonsense
    with pytest.raises(MalformedMessageError, match="trajectory"):
        received(points)


def test_a_trajectory_whose_time_runs_backwards_is_refused() -> None:
    points = rows(9)
    points[4, 0] = points[2, 0]
    with pytest.raises(MalformedMessageError, match="backwards"):
        received(points)
    points[4, 0] = points[3, 0]
    received(points)


@pytest.mark.parametrize(
    ("left_s", "sound"), [(math.nan, False), (-math.inf, False), (math.inf, True), (-2, True)]
)
def test_a_time_to_collision_is_a_number_or_never(left_s: float, sound: bool) -> None:
    message = CollisionCheck(header(1_500_000_000, "map"), 3, 2, collision=True, time_to_collision=left_s)
    if sound:
        assert verdict(message) == (1.5, 3, 2, left_s)
        return
    with pytest.raises(MalformedMessageError, match="collision"):
        verdict(message)


@pytest.mark.parametrize("nonsense", [*NONSENSE, 1e9])
def test_a_goal_out_of_this_world_is_refused(nonsense: float) -> None:
    corner = point_message(HERE)
    goal = Goal(header(0, "map"), point_message(np.array([nonsense, 0.0, 3.0])), corner, corner)
    with pytest.raises(MalformedMessageError, match="goal"):
        sound_goal(goal)


@pytest.mark.parametrize(
    ("check", "bad"), [("finite", odometry(position=np.full(3, math.nan))), ("range", odometry(MOVING * 1e6))]
)
def test_a_check_that_is_switched_off_lets_through_what_it_would_refuse(
    check: CheckName, bad: Odometry
) -> None:
    with pytest.raises(RefusedMessageError) as refused:
        state(bad, ALL_CHECKS)
    assert refused.value.check == check
    assert state(bad, frozenset()).attitude == pytest.approx(AHEAD)


def test_whole_points_are_asked_for_though_all_checks_are_off() -> None:
    message = plan_message(header(0, "map"), Plan(3, 2, rows(4)[::-1], failed=False))
    assert len(plan(message, frozenset()).points) == 4
    message.points = message.points[:-1]
    with pytest.raises(MalformedMessageError, match="numbers"):
        plan(message, frozenset())
