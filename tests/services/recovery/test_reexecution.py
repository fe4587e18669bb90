"""What a stage makes twice is compared to the bit; the copy has no part in anything and leaves nothing."""

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from services.bus.arrays import Floats
from services.bus.messages import Injection
from services.bus.proxy_link import Digest
from services.models.detection import AlarmRecord, DetectorSpec
from services.recovery.recovery import Recovery
from services.recovery.reexecution import SCHEME, Reexecution
from services.system.process_stat import children

MAKE_NS, CHECK_NS = 1000, 7


class Adder:
    """A stage that counts and tells its number; ``struck`` names the numbers that a fault changes."""

    name = "control"

    def __init__(self, struck: tuple[int, ...] = (), told_struck: tuple[int, ...] = ()) -> None:
        self.now_ns = 0
        self.number, self.made = 0, 0
        self.struck, self.told_struck = struck, told_struck
        self.told: list[bytes] = []
        self.alarms: list[AlarmRecord] = []
        self.counted: Counter[str] = Counter()
        self.in_a_copy = False
        self.fault_reach = self
        self.reached = True
        self._digest: Digest | None = None

    @contextmanager
    def overheard(self, digest: Digest, *, in_a_copy: bool) -> Iterator[None]:
        self.in_a_copy, self._digest = in_a_copy, digest
        yield
        self._digest = None

    @property
    def strikes(self) -> int:
        return sum(number <= self.made for number in (*self.struck, *self.told_struck))

    def covers_next(self, now_ns: int) -> bool:
        assert now_ns == self.now_ns
        return self.reached

    def tell(self, payload: bytes) -> None:
        if self._digest is not None:
            self._digest.update(payload)
        if not self.in_a_copy:
            self.told.append(payload)

    def add(self) -> int:
        """Add one, and tell it beside."""
        self.now_ns += MAKE_NS
        self.made += 1
        self.number += 1
        wrong = not self.in_a_copy and self.made in self.struck
        unheard = not self.in_a_copy and self.made in self.told_struck
        self.tell(b"%d" % (self.number + unheard))
        self.number += 100 * wrong
        return self.number

    def take_back(self) -> None:
        self.number = 0

    def verdict(self, payload: bytes) -> bytes | None:
        pytest.fail(f"a detector is asked: {payload!r}")

    def elapse_check(self, number: int) -> None:
        assert number == self.counted["checks"]
        self.now_ns += CHECK_NS
        self.counted["checks"] += 1

    def corrupt(self, topic: str, message: Any) -> None:
        """Let nothing strike it."""

    def count(self, what: str) -> None:
        self.counted[what] += 1

    def tell_alarm(self, record: AlarmRecord) -> None:
        self.alarms.append(record)


def payload(number: int) -> bytes:
    return b"%d" % number


def differing(stage: Adder, outputs: int = 5) -> list[int]:
    twice, found = Reexecution(stage), []
    for number in range(outputs):
        assert twice.make(stage.add, payload) == stage.number
        assert twice.took_ns == MAKE_NS
        found += [number] * twice.differed
    return found


def test_an_output_that_both_make_is_made_once_by_the_stage() -> None:
    stage = Adder()
    assert differing(stage) == []
    assert stage.number == stage.made == 5
    assert stage.now_ns == 5 * MAKE_NS
    assert stage.told == [b"1", b"2", b"3", b"4", b"5"]


def test_one_that_a_fault_changed_differs_and_those_made_from_what_it_left_do_not() -> None:
    assert differing(Adder(struck=(3,))) == [2]


def test_what_is_told_beside_is_compared_too() -> None:
    stage = Adder(told_struck=(2, 5))
    assert differing(stage) == [1, 4]
    assert stage.number == 5


def test_one_that_the_copy_did_not_finish_differs(capfd: pytest.CaptureFixture[str]) -> None:
    stage = Adder()
    twice = Reexecution(stage)

    def make() -> int:
        if stage.in_a_copy:
            os._exit(9)
        return stage.add()

    found = []
    for number, how in ((1, make), (2, stage.add)):
        assert twice.make(how, payload) == number
        found.append(twice.differed)
    assert found == [True, False]
    assert capfd.readouterr() == ("", "")


def test_where_no_fault_can_strike_no_copy_makes_it_first(capfd: pytest.CaptureFixture[str]) -> None:
    stage = Adder()
    twice = Reexecution(stage)

    def make() -> int:
        os.write(1, b"made ")
        return stage.add()

    for stage.reached in (True, False):
        twice.make(make, payload)
        assert (twice.took_ns, twice.differed) == (MAKE_NS, False)
        os.write(1, b". ")
    assert capfd.readouterr().out == "made made . made . "


def test_a_fault_that_strikes_where_it_was_not_to_is_an_error() -> None:
    stage = Adder(struck=(1,))
    stage.reached = False
    with pytest.raises(RuntimeError, match="let at an output of which there is no copy"):
        Reexecution(stage).make(stage.add, payload)


def test_no_copy_is_left() -> None:
    before = children(os.getpid())
    differing(Adder(), 20)
    assert children(os.getpid()) == before


def test_a_detector_is_not_asked_and_the_time_of_both_passes() -> None:
    stage = Adder()
    recovery = Recovery(stage, DetectorSpec(scheme=SCHEME))
    for number in range(1, 4):
        assert output(stage, recovery) == number
    assert stage.counted == Counter({"checks": 3})
    assert stage.now_ns == 3 * (2 * MAKE_NS + CHECK_NS)


def test_an_output_that_differs_is_taken_back_and_made_again() -> None:
    stage = Adder(struck=(2,))
    recovery = Recovery(stage, DetectorSpec(scheme=SCHEME))
    assert [output(stage, recovery) for _ in range(3)] == [1, 1, 2]
    assert stage.counted == Counter({"checks": 4, "alarms": 1, "recomputed": 1})
    (alarm,) = stage.alarms
    assert (alarm.stage, alarm.topic, alarm.action, alarm.cost_ns) == (
        "control",
        "injection",
        "recomputed",
        MAKE_NS,
    )
    assert stage.now_ns == 4 * (2 * MAKE_NS + CHECK_NS)


def test_with_the_gate_off_one_that_differs_is_told_and_nothing_is_dropped() -> None:
    stage = Adder(struck=(2,))
    recovery = Recovery(stage, DetectorSpec(scheme=SCHEME, gate="off"))
    assert [output(stage, recovery) for _ in range(3)] == [1, 102, 103]
    assert [one.action for one in stage.alarms] == ["published"]
    assert stage.now_ns == 3 * MAKE_NS


def test_a_decision_is_made_again_while_it_differs_and_both_take_their_time() -> None:
    stage = Adder(struck=(2,))
    recovery = Recovery(stage, DetectorSpec(scheme=SCHEME))
    assert [recovery.decided("trajectory", stage.add, payload) for _ in range(2)] == [1, 103]
    assert stage.counted == Counter({"alarms": 1, "recomputed": 1})
    (alarm,) = stage.alarms
    assert (alarm.topic, alarm.action, alarm.cost_ns) == ("trajectory", "recomputed", MAKE_NS)
    assert stage.now_ns == 3 * 2 * MAKE_NS


@pytest.mark.parametrize("how", [{"gate": "off"}, {"recovery": "off"}])
def test_a_decision_that_differs_is_told_where_nothing_is_recovered(how: dict[str, str]) -> None:
    stage = Adder(struck=(2,))
    recovery = Recovery(stage, DetectorSpec.model_validate({"scheme": SCHEME, **how}))
    assert [recovery.decided("trajectory", stage.add, payload) for _ in range(3)] == [1, 102, 103]
    assert [one.action for one in stage.alarms] == ["published"]
    assert stage.now_ns == 3 * (1 if "gate" in how else 2) * MAKE_NS


def test_without_reexecution_a_decision_is_made_once() -> None:
    stage = Adder(struck=(1,))
    for spec in (None, DetectorSpec(scheme="kinematic")):
        assert Recovery(stage, spec).decided("trajectory", stage.add, payload) > 0
    assert (stage.made, stage.alarms, stage.now_ns) == (2, [], 2 * MAKE_NS)


def output(stage: Adder, recovery: Recovery) -> int:
    made, sent = recovery.sound("injection", stage.add, message, shown, stage.take_back)
    assert sent.record == str(made)
    recovery.published("injection")
    return made


def message(number: int) -> Any:
    return Injection(record=str(number))


def shown(sent: Any) -> Floats:
    return np.array([[float(sent.record)]])
