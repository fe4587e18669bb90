"""What the detector makes of a question, and of one that is none."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from detector.node import judge
from detector.schemes.base import Scheme
from detector.schemes.registry import in_flight, rehearse, with_models
from detector.series.monitored_states import WATCHED
from services.bus.arrays import Floats, VehicleState, vector
from services.bus.detector_protocol import (
    DetectorReply,
    answer,
    answered,
    asked,
    question,
    shown_command,
    shown_trajectory,
    shown_verdict,
)
from services.bus.messages import CollisionCheck, Trajectory, Twist, TwistStamped, header
from services.models.detection import DetectorSpec
from services.models.inter_kernel_states import STATES
from services.system.shared_stats import SharedStats


@pytest.fixture
def stats() -> SharedStats:
    return SharedStats.create("detector")


@pytest.fixture
def gaussian() -> Scheme:
    return in_flight(DetectorSpec(scheme="gaussian"))


def command(speed_m_s: float) -> bytes:
    rows = np.zeros((2, len(WATCHED["control"])))
    rows[:, WATCHED["control"].index("command.vx")] = speed_m_s
    return question(rows, fresh=False)


def test_a_jump_is_alarmed_and_the_sound_value_after_it_is_not(gaussian: Scheme, stats: SharedStats) -> None:
    def judged(speed_m_s: float) -> DetectorReply | None:
        return judge(gaussian, "control", command(speed_m_s), stats.page)

    assert judged(1.0) is None
    found = judged(1e30)
    assert found is not None
    assert (found.state, found.row) == ("command.vx", 1)
    assert found.score > 1.0
    assert judged(1.0) is None
    assert stats.page["invocations"][0] == stats.page["steps"] == 3
    assert stats.page["cpu_ns"][0] > 0
    assert not stats.page["computing"]


def test_a_fresh_question_has_no_predecessor(gaussian: Scheme, stats: SharedStats) -> None:
    rows = np.zeros((2, len(WATCHED["control"])))
    assert judge(gaussian, "control", question(rows, fresh=False), stats.page) is None
    rows[:, WATCHED["control"].index("command.vx")] = 1e30
    assert judge(gaussian, "control", question(rows, fresh=True), stats.page) is None


@pytest.mark.parametrize(
    ("stage", "payload"),
    [
        ("control", b""),
        ("control", bytes(7)),
        ("control", bytes(8)),
        ("control", bytes(8 + 15)),
        ("control", bytes(8 + 8 * 15)),
        ("perception", bytes(8 + 8 * 4)),
        ("wings", bytes(8 + 16)),
    ],
)
def test_what_makes_no_sense_is_an_alarm(
    stage: str, payload: bytes, gaussian: Scheme, stats: SharedStats
) -> None:
    found = judge(gaussian, stage, payload, stats.page)
    assert found is not None
    assert found.state == ""
    assert stats.page["malformed"] == 1
    assert stats.page["invocations"][0] == 0


def test_questions_and_answers_survive_the_bus() -> None:
    rows = np.array([[1.0, np.nan], [-np.inf, 5e-324]])
    numbers, fresh = asked(question(rows, fresh=True))
    assert fresh
    assert numbers.tobytes() == rows.tobytes()
    assert answered(answer(None)) is None
    assert answered(answer(DetectorReply("command.vx", 1, 1.5))) == DetectorReply("command.vx", 1, 1.5)
    infinite = answered(answer(DetectorReply("command.vx", 1, np.inf)))
    assert infinite is not None
    assert 1e300 < infinite.score < np.inf


def test_what_is_shown_stands_in_the_watched_columns() -> None:
    """Each state of a message, struck alone, shows in its own column and in no other."""
    shown: dict[str, Callable[[Any], Floats]] = {
        "perception": shown_verdict,
        "planning": shown_trajectory,
        "control": lambda message: shown_command(
            message, 0, np.zeros((2, 10)), VehicleState(np.zeros(3), np.zeros(3), np.zeros(4), 0.0)
        ),
    }
    for stage, show in shown.items():
        for column, name in enumerate(WATCHED[stage]):
            state = STATES.get(name)
            if state is None or state.stage != stage:
                continue  # a waypoint's, which control takes from its follower
            message = blank(stage)
            before = show(message)
            values = state.values(message)
            values[-1] = 3
            state.put(message, values)
            changed = np.flatnonzero((show(message) != before).any(axis=0))
            assert changed.tolist() == [column], name


def blank(stage: str) -> Any:
    head = header(0, "map")
    if stage == "perception":
        return CollisionCheck(
            header=head, trajectory_seq=0, future_collision_seq=0, collision=False, time_to_collision=0.0
        )
    if stage == "planning":
        return Trajectory(
            header=head, trajectory_seq=0, future_collision_seq=0, failed=False, points=np.zeros(24)
        )
    zero = vector(np.zeros(3))
    return TwistStamped(header=head, twist=Twist(linear=zero, angular=vector(np.zeros(3))))


@pytest.mark.parametrize("name", with_models())
def test_a_rehearsal_is_forgotten(name: str) -> None:
    rehearsed, new = in_flight(DetectorSpec(scheme=name)), in_flight(DetectorSpec(scheme=name))
    rehearse(rehearsed)
    draw = np.random.default_rng(1)
    for stage, columns in WATCHED.items():
        for _ in range(3):
            rows = draw.normal(size=({"perception": 1, "planning": 5, "control": 2}[stage], len(columns)))
            assert rehearsed.score(stage, rows) == new.score(stage, rows)
            assert rehearsed.check(stage, rows) == new.check(stage, rows)
