"""Recovery of a stage: its output is held until it is found sound, and made again while it is not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeVar

RETRIES_MAX = 2
"""For one output. A fault is transient: what is alarmed again was no fault, and holding it costs time."""

Made = TypeVar("Made")
Alarm = Callable[[str, Any], bool]
"""Whether an output of a topic is found wrong."""


def unwatched(_topic: str, _output: Any) -> bool:
    """Without a detector nothing is found wrong."""
    return False


class Recovery:
    """One stage's way to make an output again: bounded, counted, and timed by the kernels that run again.

    ``alarmed`` is the detector's verdict on a message that is about to be published, after ``corrupt``,
    by which a source-level fault strikes it.
    """

    def __init__(
        self,
        count: Callable[[Literal["alarms", "recomputed"]], None],
        corrupt: Callable[[str, Any], None] = lambda _topic, _message: None,
    ) -> None:
        self.alarmed: Alarm = unwatched
        self._count = count
        self._corrupt = corrupt

    def sound(
        self,
        topic: str,
        compute: Callable[[], Made],
        message: Callable[[Made], Any],
        before_again: Callable[[], object] | None = None,
    ) -> tuple[Made, Any]:
        """What ``compute`` makes and the ``message`` of it; made again while that is alarmed.

        The last of ``RETRIES_MAX`` repetitions is taken whatever is said of it. ``before_again`` comes
        before each.
        """
        for retry in range(RETRIES_MAX + 1):
            made = compute()
            sent = message(made)
            self._corrupt(topic, sent)
            if not self.alarmed(topic, sent):
                break
            self._count("alarms")
            if retry == RETRIES_MAX:
                break
            if before_again is not None:
                before_again()
            self._count("recomputed")
        return made, sent
