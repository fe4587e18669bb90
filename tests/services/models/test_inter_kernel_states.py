"""Every inter-kernel state can be read from, and written into, the message that carries it."""

import numpy as np
import pytest

from services.bus.arrays import NO_PLAN, POINT_FIELDS, cloud_message, plan_message, vector
from services.bus.messages import CollisionCheck, Twist, TwistStamped, decode, encode, header
from services.bus.topics import TOPICS
from services.models.inter_kernel_states import GROUPS, STATES, members

POINTS = np.arange(3.0 * POINT_FIELDS).reshape(3, POINT_FIELDS)
CLOUD = np.arange(12, dtype=np.float32).reshape(4, 3)


def carrier(topic: str) -> object:
    """A message of the topic as a stage makes it."""
    stamp = header(0, "map")
    if topic == "cloud":
        return cloud_message(stamp, CLOUD)
    if topic == "collision_check":
        return CollisionCheck(stamp, 1, 2, True, 3.5)
    if topic == "trajectory":
        return plan_message(stamp, NO_PLAN._replace(trajectory_seq=4, future_collision_seq=5, points=POINTS))
    return TwistStamped(stamp, Twist(vector(np.array([1.0, 2.0, 3.0])), vector(np.array([0.0, 0.0, 0.5]))))


@pytest.mark.parametrize("name", STATES)
def test_what_is_put_is_read_back_after_the_bus(name: str) -> None:
    state = STATES[name]
    message = carrier(state.topic)
    values = state.values(message)
    values[-1] += 7
    state.put(message, values)
    type_name = TOPICS[state.topic].type
    received = decode(encode(message, type_name), type_name)
    np.testing.assert_array_equal(state.values(received), values)
    for other in STATES.values():
        if other.topic == state.topic and other is not state:
            np.testing.assert_array_equal(other.values(received), other.values(carrier(state.topic)))


def test_a_trajectory_has_one_value_for_each_point() -> None:
    message = carrier("trajectory")
    np.testing.assert_array_equal(STATES["trajectory.ax"].values(message), POINTS[:, 7])
    np.testing.assert_array_equal(STATES["cloud.y"].values(carrier("cloud")), CLOUD[:, 1])


def test_what_the_stage_holds_itself_is_not_touched() -> None:
    points = POINTS.copy()
    message = plan_message(header(0, "map"), NO_PLAN._replace(points=points))
    STATES["trajectory.x"].put(message, np.zeros(3))
    np.testing.assert_array_equal(points, POINTS)


def test_groups_are_states_of_one_topic() -> None:
    for name, parts in GROUPS.items():
        assert {state.topic for state in members(name)} == {name.partition(".")[0]}
        assert len(parts) == 3
    with pytest.raises(KeyError):
        members("command.speed")
