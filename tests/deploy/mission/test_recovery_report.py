"""What recovery did and whether the flight came nearer its twin; paths here are made by hand."""

import numpy as np
import pytest

from deploy.mission.judgement import judge_recovery
from services.models.detection import Action, AlarmRecord, DetectionReport
from sim.mission.true_path import TruePath


def path(offsets: list[float]) -> TruePath:
    """One metre east and one second from row to row, so far north."""
    count = len(offsets)
    position = np.column_stack([np.arange(count), offsets, np.zeros(count)])
    return TruePath(np.arange(count, dtype=float), position, np.zeros(count), np.zeros(count))


def alarm(at_s: float, action: Action, *, true: bool = True) -> AlarmRecord:
    return AlarmRecord(
        stage="control",
        topic="command",
        state="",
        row=0,
        score=2.0,
        virtual_time_ns=round(at_s * 1e9),
        action=action,
        cost_ns=5,
        true=true,
    )


def report(*alarms: AlarmRecord) -> DetectionReport:
    return DetectionReport(
        alarms=list(alarms), checks=9, detection_share=0.0, recomputation_share=0.0, ungated=0
    )


STRAIGHT = path([0.0] * 6)


@pytest.mark.parametrize(("end_m", "nearer"), [(0.5, True), (3.0, False)])
def test_the_offset_is_told_from_the_first_action_on_a_true_alarm_to_the_end(
    end_m: float, nearer: bool
) -> None:
    alarms = [
        alarm(0.5, "recomputed", true=False),
        alarm(1.5, "published"),
        alarm(2.5, "recomputed"),
        alarm(2.9, "simple"),
        alarm(3.5, "simple"),
    ]
    found = judge_recovery(report(*alarms), path([0.0, 0.0, 2.0, 4.0, 4.0, end_m]), STRAIGHT)
    assert found is not None
    recovery = found.recovery
    assert recovery is not None
    assert recovery.actions == {"recomputed": 1, "simple": 2}
    assert recovery.cost_ns == 15
    assert [recovery.offset_m, recovery.end_offset_m] == pytest.approx([2.0, end_m])
    assert recovery.came_nearer == nearer


def test_there_is_none_where_nothing_was_done_or_flown() -> None:
    idle = report(alarm(1.0, "published"), alarm(2.0, "stop", true=False))
    assert judge_recovery(idle, STRAIGHT, STRAIGHT) == idle
    acted = report(alarm(1.0, "stop"))
    assert judge_recovery(acted, path([]), STRAIGHT) == acted
    assert judge_recovery(None, STRAIGHT, STRAIGHT) is None
