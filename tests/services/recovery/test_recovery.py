"""An output that is found wrong is made again, so many times and no more, and every time is counted."""

from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import numpy as np
import pytest

from services.bus.arrays import Floats
from services.bus.detector_protocol import DetectorReply, answer, asked
from services.bus.proxy_link import Digest
from services.models.detection import AlarmRecord, DetectorSpec, Fallback
from services.recovery.recovery import Recovery

CHECK_NS, MAKE_NS = 7, 1000


class NoFault:
    """Nothing is struck."""

    strikes = 0

    def covers_next(self, now_ns: int) -> bool:
        return now_ns < 0


class Control:
    """A stage of which the numbers below ``wrong`` are alarmed; the detector dies after ``answers``."""

    name = "control"
    fault_reach = NoFault()

    def __init__(self, wrong: float, answers: int = 1_000_000) -> None:
        self.now_ns = 0
        self.wrong = wrong
        self.answers = answers
        self.counted: Counter[str] = Counter()
        self.told: list[AlarmRecord] = []
        self.fresh: list[bool] = []
        self.made = -1

    def verdict(self, payload: bytes) -> bytes | None:
        rows, fresh = asked(payload)
        self.fresh.append(fresh)
        self.answers -= 1
        if self.answers < 0:
            return None
        return answer(DetectorReply("command.vx", 1, np.inf) if rows[0] < self.wrong else None)

    def elapse_check(self, number: int) -> None:
        assert number == self.counted["checks"]
        self.counted["checks"] += 1
        self.now_ns += CHECK_NS

    def corrupt(self, topic: str, message: Any) -> None:
        assert (topic, message) == ("command", str(self.made))

    def count(self, what: str) -> None:
        self.counted[what] += 1

    def tell_alarm(self, record: AlarmRecord) -> None:
        self.told.append(record)

    def overheard(self, digest: Digest, *, in_a_copy: bool) -> AbstractContextManager[None]:
        pytest.fail(f"the output is made in a copy: {digest}, {in_a_copy}")

    def compute(self) -> int:
        self.made += 1
        self.now_ns += MAKE_NS
        return self.made

    def skip(self) -> None:
        self.counted["skipped"] += 1


def shown(message: str) -> Floats:
    return np.array([[float(message)]])


def output(stage: Control, recovery: Recovery) -> int:
    made, sent = recovery.sound("command", stage.compute, str, shown, stage.skip)
    assert sent == str(made)
    recovery.published("command")
    return made


@pytest.mark.parametrize(
    ("wrong", "alarms", "again"), [(0, 0, 0), (1, 1, 1), (2, 2, 2), (3, 3, 2), (99, 3, 2)]
)
def test_the_first_sound_output_is_taken_or_the_last(wrong: int, alarms: int, again: int) -> None:
    stage = Control(wrong)
    recovery = Recovery(stage, DetectorSpec(scheme="any", retries=2))
    assert output(stage, recovery) == again
    counted = {"alarms": alarms, "recomputed": again, "skipped": again, "checks": 1 + again}
    assert stage.counted == Counter(counted)
    assert stage.now_ns == (1 + again) * (CHECK_NS + MAKE_NS)
    assert [one.cost_ns for one in stage.told] == [MAKE_NS] * again + [0] * (alarms - again)
    # Another waypoint, or an output that was never found sound, is nothing to compare the next one with.
    assert stage.fresh == [True] * (1 + again)
    output(stage, recovery)
    assert stage.fresh[1 + again] is (alarms > again)


@pytest.mark.parametrize("recovery", ["off", "perception", "planning"])
def test_a_stage_outside_the_scope_only_tells(recovery: str) -> None:
    stage = Control(99)
    spec = DetectorSpec.model_validate({"scheme": "any", "recovery": recovery})
    assert output(stage, Recovery(stage, spec)) == 0
    assert [one.action for one in stage.told] == ["published"]
    assert stage.counted == Counter({"alarms": 1, "checks": 1})


@pytest.mark.parametrize(
    ("scope", "recovering"),
    [
        ("all", {"perception", "planning", "control"}),
        ("planning_control", {"planning", "control"}),
        ("perception", {"perception"}),
    ],
)
def test_a_scope_names_the_stages_that_recover(scope: str, recovering: set[str]) -> None:
    spec = DetectorSpec.model_validate({"scheme": "any", "recovery": scope})
    found = set()
    for name in ("perception", "planning", "control"):
        stage = Control(1)
        stage.name = name
        if output(stage, Recovery(stage, spec)) == 1:
            found.add(name)
    assert found == recovering


ALARMED = 2


@pytest.mark.parametrize(
    ("fallback", "published", "action"),
    [
        ("as_made", 2, "published"),
        ("last_good", 0, "last_good"),
        ("stop", -7, "stop"),
        ("simple", -8, "simple"),
    ],
)
@pytest.mark.parametrize("retries", [0, 1])
def test_what_stays_alarmed_is_replaced(fallback: str, published: int, action: str, retries: int) -> None:
    spec = DetectorSpec.model_validate({"scheme": "any", "retries": retries, "control": fallback})
    stage = Control(0)
    undone: list[bool] = []
    recovery = Recovery(stage, spec)
    instead: dict[Fallback, Callable[[], int]] = {"stop": lambda: -7, "simple": lambda: -8}

    def publish() -> int:
        undo = partial(undone.append, True)
        made, sent = recovery.sound("command", stage.compute, str, shown, stage.skip, instead, undo)
        assert sent == str(made)
        return made

    assert publish() == 0
    stage.wrong = 3
    stage.made = ALARMED - 1 - retries
    assert publish() == published
    assert undone == [True] * (action != "published")
    assert stage.told[-1].action == action
    assert stage.counted["recomputed"] == retries
    stage.wrong = 0
    assert publish() == ALARMED + 1


def test_what_was_alarmed_is_never_the_last_good_one() -> None:
    stage = Control(99)
    recovery = Recovery(stage, DetectorSpec(scheme="any", retries=0, control="last_good"))
    assert output(stage, recovery) == 0
    assert output(stage, recovery) == 1
    assert [one.action for one in stage.told] == ["published", "published"]


@pytest.mark.parametrize("retries", [0, 1])
def test_the_last_good_output_is_the_newest_that_was_accepted(retries: int) -> None:
    stage = Control(0)
    recovery = Recovery(stage, DetectorSpec(scheme="any", retries=retries, control="last_good"))
    assert [output(stage, recovery) for _ in range(3)] == [0, 1, 2]
    stage.wrong = 99
    assert [output(stage, recovery) for _ in range(2)] == [2, 2]


def test_a_stage_that_does_not_recover_has_no_fallback() -> None:
    stage = Control(99)
    recovery = Recovery(stage, DetectorSpec(scheme="any", recovery="planning", control="last_good"))
    stage.wrong = 0
    assert output(stage, recovery) == 0
    stage.wrong = 99
    assert output(stage, recovery) == 1
    assert [one.action for one in stage.told] == ["published"]


def test_with_the_gate_off_an_output_is_not_held_and_its_alarm_acts_on_the_next() -> None:
    stage = Control(1)
    recovery = Recovery(stage, DetectorSpec(scheme="any", gate="off"))
    assert output(stage, recovery) == 0
    assert stage.now_ns == MAKE_NS
    assert [one.action for one in stage.told] == ["waypoint_dropped"]
    assert not stage.counted["skipped"]
    assert output(stage, recovery) == 1
    assert output(stage, recovery) == 2
    assert stage.counted == Counter({"alarms": 1, "skipped": 1})


def test_a_dead_detector_is_asked_once_and_its_time_passes_on() -> None:
    stage = Control(0, answers=1)
    recovery = Recovery(stage, DetectorSpec(scheme="any"))
    for number in range(4):
        assert output(stage, recovery) == number
    assert stage.answers == -1
    assert stage.counted == Counter({"checks": 4, "ungated": 3})
    assert stage.now_ns == 4 * (CHECK_NS + MAKE_NS)


def test_without_a_detector_nothing_is_made_twice() -> None:
    stage = Control(99)
    assert output(stage, Recovery(stage, None)) == 0
    assert not stage.counted
