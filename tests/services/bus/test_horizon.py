"""Messages come out by virtual time, however the bus delivers them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.bus.horizon import (
    NEVER_NS,
    Channel,
    Promise,
    Stamped,
    earliest_activation,
    next_activation,
)


def message(seq: int, ready_ns: int) -> Stamped:
    return Stamped(seq, ready_ns, b"")


@given(st.permutations(range(8)), st.lists(st.integers(0, 7), max_size=5))
def test_any_order_of_arrival_gives_the_same_stream(order: list[int], again: list[int]) -> None:
    channel = Channel()
    for seq in [*order, *again]:
        channel.receive(message(seq, 10 * seq))
    assert [one.seq for one in channel.take(NEVER_NS, inclusive=True)] == list(range(8))
    assert channel.duplicates == len(again)


def test_a_promise_holds_only_when_all_it_speaks_of_is_here() -> None:
    channel = Channel()
    channel.promise(2, 500)
    channel.receive(message(1, 20))
    assert channel.horizon_ns == 0
    channel.receive(message(0, 10))
    assert channel.horizon_ns == 500


def test_an_older_promise_never_takes_back_a_newer_one() -> None:
    channel = Channel()
    channel.promise(0, 500)
    channel.promise(0, 300)
    assert channel.horizon_ns == 500


def test_what_is_ready_later_stays_hidden() -> None:
    channel = Channel()
    for seq, ready in enumerate((10, 20, 30)):
        channel.receive(message(seq, ready))
    assert [one.ready_ns for one in channel.take(20, inclusive=False)] == [10]
    assert [one.ready_ns for one in channel.take(20, inclusive=True)] == [20]
    assert channel.head == message(2, 30)


def test_a_restarted_stage_sees_nothing_from_before_its_start() -> None:
    channel = Channel(first_seq=5, ignore_before_ns=100)
    channel.receive(message(5, 90))
    channel.receive(message(6, 100))
    assert [one.seq for one in channel.take(NEVER_NS, inclusive=True)] == [6]


def test_a_free_stage_starts_with_its_first_trigger() -> None:
    channel = Channel()
    assert next_activation(channel, 0) is None
    channel.receive(message(0, 40))
    assert next_activation(channel, 0) == 40


def test_a_busy_stage_waits_until_no_newer_trigger_can_come() -> None:
    channel = Channel()
    channel.receive(message(0, 40))
    channel.promise(1, 100)
    assert next_activation(channel, 100) is None
    channel.promise(1, 101)
    assert next_activation(channel, 100) == 100


def test_a_promise_is_built_on_the_earliest_possible_start() -> None:
    channel = Channel()
    channel.promise(0, 80)
    assert earliest_activation(channel, 50) == 80
    assert earliest_activation(channel, 90) == 90
    channel.receive(message(0, 85))
    assert earliest_activation(channel, 50) == 85


def test_a_promise_waits_for_its_last_message() -> None:
    channel = Channel()
    channel.promise(2, 500)
    channel.receive(message(0, 10))
    assert channel.horizon_ns == 0
    channel.receive(message(1, 20))
    assert channel.horizon_ns == 500


def test_a_trigger_at_the_moment_a_stage_is_free_is_taken_up_then() -> None:
    channel = Channel()
    channel.receive(message(0, 40))
    assert next_activation(channel, 40) == 40


def test_a_message_that_comes_twice_before_its_turn_is_counted() -> None:
    channel = Channel()
    channel.receive(message(1, 20))
    channel.receive(message(1, 20))
    assert channel.duplicates == 1


def test_a_promise_is_what_was_packed() -> None:
    promise = Promise((3 << 32) + 7, 40, 80, (NEVER_NS, 120), (5, 0))
    assert Promise.unpacked(promise.packed(), 2) == promise


@pytest.mark.parametrize("topics", [0, 1, 3])
def test_a_promise_on_other_topics_is_refused(topics: int) -> None:
    promise = Promise(1, 40, 80, (NEVER_NS, 120), (5, 0))
    with pytest.raises(ValueError, match=f"on {topics} topics"):
        Promise.unpacked(promise.packed(), topics)
