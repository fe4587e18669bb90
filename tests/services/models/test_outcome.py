"""The record of a fault that recurs: the first strike, the first hundred in full, and how many there were."""

import pytest

from services.models.outcome import STRIKES_KEPT, InjectionRecord, RepeatedInjection, strike_of, with_strike

pytestmark = pytest.mark.unit


def struck(invocation: int, **more: object) -> InjectionRecord:
    return InjectionRecord.model_validate(
        {"status": "injected", "node": "control", "kernel": "pid", "invocation": invocation, **more}
    )


def of_a_call(invocation: int, strikes: int) -> InjectionRecord:
    """As the injector tells the strikes of a call: not more of them in full than are kept."""
    told = [strike_of(struck(invocation))] * min(strikes, STRIKES_KEPT)
    return struck(invocation, strikes=strikes, struck=told)


def test_strikes_are_counted_and_the_first_are_kept() -> None:
    found: InjectionRecord | None = None
    for number in range(STRIKES_KEPT + 20):
        found = with_strike(found, struck(number))
    assert found is not None
    assert (found.invocation, found.strikes) == (0, STRIKES_KEPT + 20)
    assert [one.invocation for one in found.struck] == list(range(STRIKES_KEPT))


def test_strikes_of_a_call_are_added_at_once() -> None:
    found = with_strike(of_a_call(3, 60), of_a_call(4, 5000))
    found = with_strike(found, struck(5, strikes=7))
    assert (found.invocation, found.strikes) == (3, 5067)
    assert [one.invocation for one in found.struck] == [3] * 60 + [4] * 40


def test_what_was_not_struck_gives_way_to_what_was() -> None:
    nothing = struck(1).model_copy(update={"status": "not_activated", "reason": "no call was struck"})
    assert with_strike(None, nothing) == nothing
    found = with_strike(nothing, of_a_call(2, 3))
    assert (found.status, found.reason, found.invocation, found.strikes) == ("injected", "", 2, 3)
    assert with_strike(found, nothing) == found


def test_why_strikes_are_not_counted_is_kept() -> None:
    killed = of_a_call(2, 3).model_copy(update={"reason": "killed in a call"})
    assert with_strike(of_a_call(1, 3), killed).reason == "killed in a call"


def test_strikes_that_were_stored_without_an_instruction_are_read() -> None:
    before = {"invocation": 1, "virtual_time_ns": 5, "state": ["command.vx"], "point": 0, "bits": [1]}
    values = {"before": "0", "after": "1", "read_back": "1"}
    assert RepeatedInjection.model_validate({**before, **values}).instruction == ""
