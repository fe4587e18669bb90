"""One message of one state is struck, once, at the drawn bits, and the record tells."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chisquare, poisson

from services.bus.arrays import NO_PLAN, POINT_FIELDS, plan_message
from services.bus.messages import CollisionCheck, Twist, TwistStamped, Vector3, header
from services.models.faults.specification import FaultSpec, Trigger
from services.models.inter_kernel_states import STATES
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
        assert struck.strike(message, 1, 0) == []
        np.testing.assert_array_equal(STATES["trajectory.vx"].values(message), POINTS[:, 4])
        (record,) = struck.strike(message, 2, 77)
        values = STATES["trajectory.vx"].values(message)
        different = np.flatnonzero(values != POINTS[:, 4])
        assert list(different) == [record.point]
        assert changed_bits(POINTS[record.point, 4], values[record.point]) == record.bits
        assert low <= record.bits[0] <= high
        assert (record.status, record.invocation, record.virtual_time_ns) == ("injected", 2, 77)
        assert record.read_back == record.after == f"{values.view(np.uint64)[record.point]:016x}"


def test_it_strikes_once_so_that_what_is_made_again_is_clean() -> None:
    struck = fault("command.vx")
    assert struck.strike(commanded(), 2, 0) != []
    again = commanded()
    assert struck.strike(again, 2, 0) == []
    assert again.twist.linear.x == 1.0


def test_all_components_or_one() -> None:
    message = commanded()
    (record,) = fault("command.velocity", components="all", bits=2).strike(message, 2, 0)
    assert record.state == ["command.vx", "command.vy", "command.vz"]
    assert len(set(record.bits)) == 6
    assert [bit // WIDTH for bit in record.bits] == [0, 0, 1, 1, 2, 2]
    linear = message.twist.linear
    for index, (was, now) in enumerate(zip((1.0, 2.0, 3.0), (linear.x, linear.y, linear.z), strict=True)):
        part = [bit - WIDTH * index for bit in record.bits if bit // WIDTH == index]
        assert changed_bits(was, now) == part
    drawn = {fault("command.velocity", seed=seed).strike(commanded(), 2, 0)[0].state[0] for seed in range(30)}
    assert drawn == {"command.vx", "command.vy", "command.vz"}


def test_an_integer_and_a_given_bit() -> None:
    message = CollisionCheck(header(0, "map"), 1, 5, False, np.inf)
    (record,) = fault("collision_check.future_collision_seq", bit_numbers=[3]).strike(message, 2, 0)
    assert STATES["collision_check.future_collision_seq"].values(message) == 5 + 8
    assert (record.width_bits, record.element_bits, record.bits) == (32, 0, [3])


def test_a_point_that_is_not_there_is_not_struck() -> None:
    for message, point in ((plan_message(header(0, "map"), NO_PLAN), None), (planned(), 5)):
        (record,) = fault("trajectory.x", point=point).strike(message, 2, 0)
        assert record.status == "not_activated"
        assert "points" in record.reason


def test_without_the_flip_all_is_as_it_was() -> None:
    message = planned()
    (record,) = fault("trajectory.x", model="none").strike(message, 2, 0)
    assert record.status == "not_activated"
    np.testing.assert_array_equal(STATES["trajectory.x"].values(message), POINTS[:, 1])


def test_over_time_it_is_the_first_message_after_the_moment() -> None:
    spec = FaultSpec(level="source", target="command.vx", trigger=Trigger(after_ns=50))
    struck = SourceFault(spec, 1)
    assert struck.strike(commanded(), 0, 49) == []
    (record,) = struck.strike(commanded(), 1, 51)
    assert record.trigger is not None
    assert record.trigger.invocation == 1


TICK_NS = 40_000_000
MANY = 10_000


def recurring(**fields: object) -> SourceFault:
    return fault("command.vx", trigger=None, **fields)


def struck_in(one: SourceFault, messages: int = MANY) -> list[int]:
    """The numbers of the messages that were struck, as often as they were."""
    return [
        record.invocation
        for number in range(messages)
        for record in one.strike(commanded(), number, number * TICK_NS)
    ]


def test_an_intermittent_fault_strikes_each_message_with_its_probability() -> None:
    found = struck_in(recurring(recurrence="intermittent", probability=0.2))
    gaps = Counter(min(after - before, 12) for before, after in pairwise(found))
    expected = [0.2 * 0.8 ** (gap - 1) for gap in range(1, 12)]
    observed = [gaps[gap] for gap in range(1, 13)]
    assert chisquare(observed, np.array([*expected, 1 - sum(expected)]) * sum(observed)).pvalue > 0.01


def test_upsets_come_as_a_poisson_process_in_virtual_time() -> None:
    found = struck_in(recurring(recurrence="rate", rate_hz=2.0))
    a_second = Counter(Counter(number * TICK_NS // 10**9 for number in found).values())
    a_second[0] = MANY * TICK_NS // 10**9 - sum(a_second.values())
    seconds = sum(a_second.values())
    expected = poisson(2.0).pmf(np.arange(6))
    observed = [a_second[count] for count in range(6)]
    observed.append(seconds - sum(observed))
    assert chisquare(observed, np.array([*expected, 1 - sum(expected)]) * seconds).pvalue > 0.01


def test_the_bits_of_each_strike_are_drawn_anew_and_uniformly() -> None:
    one = recurring(recurrence="intermittent", probability=1.0)
    found = Counter(
        bit for number in range(MANY) for record in one.strike(commanded(), number, 0) for bit in record.bits
    )
    assert chisquare([found[bit] for bit in range(WIDTH)]).pvalue > 0.01


def test_a_permanent_fault_strikes_every_message_in_the_same_bits() -> None:
    one = recurring(recurrence="permanent", from_s=1.0)
    records = [record for number in range(50) for record in one.strike(commanded(), number, number * TICK_NS)]
    assert [record.invocation for record in records] == list(range(25, 50))
    assert len({tuple(record.bits) for record in records}) == 1


def test_a_recurring_fault_keeps_its_window_and_repeats() -> None:
    window = {"from_s": 1.0, "until_s": 2.0, "seed": 3}
    for kind in ({"recurrence": "intermittent", "probability": 0.5}, {"recurrence": "rate", "rate_hz": 20.0}):
        found = struck_in(recurring(**kind, **window), 100)
        assert found
        assert min(found) >= 25
        assert max(found) <= 50
        assert struck_in(recurring(**kind, **window), 100) == found


def test_a_stage_that_comes_back_is_not_struck_by_what_it_missed() -> None:
    spec = FaultSpec(level="source", target="command.vx", recurrence="rate", rate_hz=5.0)
    before = struck_in(SourceFault(spec, mission_seed=1), 500)
    late = SourceFault(spec, mission_seed=1, start_ns=250 * TICK_NS)
    after = [n for n in range(250, 500) for _ in late.strike(commanded(), n, n * TICK_NS)]
    assert after == [number for number in before if number > 250]


def test_it_may_strike_the_message_that_it_names_until_it_has() -> None:
    struck = fault("command.vx")
    assert [struck.may_strike(number, 0) for number in range(4)] == [False, False, True, False]
    struck.strike(commanded(), 2, 0)
    assert not struck.may_strike(2, 0)


def test_one_that_recurs_or_waits_for_a_time_may_strike_every_message_before_its_end() -> None:
    window = {"trigger": None, "recurrence": "intermittent", "probability": 0.5, "until_s": 2.0}
    assert fault("command.vx", **window).may_strike(0, 1_999_999_999)
    assert not fault("command.vx", **window).may_strike(0, 2_000_000_000)
    assert fault("command.vx", trigger={"after_ns": 5}).may_strike(0, 0)
    assert not fault("command.vx", trigger=None).may_strike(0, 0)
