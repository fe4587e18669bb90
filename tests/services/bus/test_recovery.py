"""An output that is found wrong is made again, so many times and no more, and every time is counted."""

from collections import Counter

import pytest

from services.bus.recovery import RETRIES_MAX, Recovery


@pytest.mark.parametrize(
    ("wrong", "alarms", "recomputed"),
    [(0, 0, 0), (1, 1, 1), (RETRIES_MAX, RETRIES_MAX, RETRIES_MAX), (99, RETRIES_MAX + 1, RETRIES_MAX)],
)
def test_the_first_sound_output_is_taken_or_the_last(wrong: int, alarms: int, recomputed: int) -> None:
    counted: Counter[str] = Counter()
    made: list[int] = []
    skipped: list[int] = []
    stage = Recovery(lambda what: counted.update([what]))
    stage.alarmed = lambda topic, output: topic == "command" and int(output) < wrong

    def compute() -> int:
        made.append(len(made))
        return made[-1]

    assert stage.sound("command", compute, str, lambda: skipped.append(len(made))) == (
        recomputed,
        str(recomputed),
    )
    assert counted == Counter({"alarms": alarms, "recomputed": recomputed})
    assert len(made) == recomputed + 1
    assert len(skipped) == recomputed


def test_without_a_detector_nothing_is_made_twice() -> None:
    counted: Counter[str] = Counter()
    assert Recovery(lambda what: counted.update([what])).sound("command", lambda: 7, str) == (7, "7")
    assert not counted
