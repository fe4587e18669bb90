"""One message of one state is struck, once, at the drawn bits, and the record tells."""

import numpy as np
import pytest

from services.bus.arrays import NO_PLAN, POINT_FIELDS, plan_message
from services.bus.messages import CollisionCheck, Twist, TwistStamped, Vector3, header
from services.models.inter_kernel_states import STATES
from services.models.mission import FaultSpec, Trigger
from services.runtime.source_fault import SourceFault

POINTS = np.linspace(0.1, 9.0, 5 * POINT_FIELDS).reshape(5, POINT_FIELDS)
WIDTH = 64


def planned() -> object:
    return plan_message(header(0, "map"), NO_PLAN._replace(points=POINTS))


def commanded() -> TwistStamped:
    return TwistStamped(header(0, "map"), Twist(Vector3(1.0, 2.0, 3.0), Vector3(0.0, 0.0, 0.5)))


def fault(target: str, **fields: object) -> SourceFault:
    given = {"level": "source", "target": target, "trigger": {"invocation": 2}, **fields}
    return SourceFault(FaultSpec.model_validate(given), mission_seed=1)


def changed_bits(before: float, after: float) -> list[int]:
    differing = int(np.float64(before).view(np.uint64) ^ np.float64(after).view(np.uint64))
    return [bit for bit in range(WIDTH) if differing >> bit & 1]


@pytest.mark.parametrize(
    ("field", "low", "high"), [("mantissa", 0, 51), ("exponent", 52, 62), ("sign", 63, 63), ("any", 0, 63)]
)
def test_one_value_of_the_named_message_has_bits_of_the_field_changed(
    field: str, low: int, high: int
) -> None:
    for seed in range(20):
        struck = fault("trajectory.vx", field=field, seed=seed)
        message = planned()
        assert struck.strike(message, 1, 0) is None
        np.testing.assert_array_equal(STATES["trajectory.vx"].values(message), POINTS[:, 4])
        record = struck.strike(message, 2, 77)
        assert record is not None
        values = STATES["trajectory.vx"].values(message)
        different = np.flatnonzero(values != POINTS[:, 4])
        assert list(different) == [record.point]
        assert changed_bits(POINTS[record.point, 4], values[record.point]) == record.bits
        assert low <= record.bits[0] <= high
        assert (record.status, record.invocation, record.virtual_time_ns) == ("injected", 2, 77)
        assert record.read_back == record.after == f"{values.view(np.uint64)[record.point]:016x}"


def test_it_strikes_once_so_that_what_is_made_again_is_clean() -> None:
    struck = fault("command.vx")
    assert struck.strike(commanded(), 2, 0) is not None
    again = commanded()
    assert struck.strike(again, 2, 0) is None
    assert again.twist.linear.x == 1.0


def test_all_components_or_one() -> None:
    message = commanded()
    record = fault("command.velocity", components="all", bits=2).strike(message, 2, 0)
    assert record is not None
    assert record.state == ["command.vx", "command.vy", "command.vz"]
    assert len(set(record.bits)) == 6
    assert [bit // WIDTH for bit in record.bits] == [0, 0, 1, 1, 2, 2]
    linear = message.twist.linear
    for index, (was, now) in enumerate(zip((1.0, 2.0, 3.0), (linear.x, linear.y, linear.z), strict=True)):
        part = [bit - WIDTH * index for bit in record.bits if bit // WIDTH == index]
        assert changed_bits(was, now) == part
    drawn = {fault("command.velocity", seed=seed).strike(commanded(), 2, 0).state[0] for seed in range(30)}  # type: ignore[union-attr]
    assert drawn == {"command.vx", "command.vy", "command.vz"}


def test_an_integer_and_a_given_bit() -> None:
    message = CollisionCheck(header(0, "map"), 1, 5, False, np.inf)
    record = fault("collision_check.future_collision_seq", bit_numbers=[3]).strike(message, 2, 0)
    assert record is not None
    assert STATES["collision_check.future_collision_seq"].values(message) == 5 + 8
    assert (record.width_bits, record.element_bits, record.bits) == (32, 0, [3])


def test_a_point_that_is_not_there_is_not_struck() -> None:
    for message, point in ((plan_message(header(0, "map"), NO_PLAN), None), (planned(), 5)):
        record = fault("trajectory.x", point=point).strike(message, 2, 0)
        assert record is not None
        assert record.status == "not_activated"
        assert "points" in record.reason


def test_without_the_flip_all_is_as_it_was() -> None:
    message = planned()
    record = fault("trajectory.x", model="none").strike(message, 2, 0)
    assert record is not None
    assert record.status == "not_activated"
    np.testing.assert_array_equal(STATES["trajectory.x"].values(message), POINTS[:, 1])


def test_over_time_it_is_the_first_message_after_the_moment() -> None:
    spec = FaultSpec(level="source", target="command.vx", trigger=Trigger(after_ns=50))
    struck = SourceFault(spec, 1)
    assert struck.strike(commanded(), 0, 49) is None
    record = struck.strike(commanded(), 1, 51)
    assert record is not None
    assert record.trigger is not None
    assert record.trigger.invocation == 1
