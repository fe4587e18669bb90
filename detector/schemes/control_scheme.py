"""What schemes have in common that watch control alone, by a compiled test with a memory."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from detector.schemes.base import Alarm, Floats, Scheme

STAGE = "control"

KNOWN, SCORE = 0, 1
"""The first places of each memory: whether, or how many, ticks came before; the score of the last check."""


class ControlScheme(Scheme):
    """A scheme with one memory, all zero at the beginning, and the ``numbers`` of a model in one row.

    An alarm names one of the ``states``, in the row ``alarmed_row`` of a check.
    """

    states: ClassVar[tuple[str, ...]]
    alarmed_row: ClassVar[int] = 1

    def __init__(self, numbers: Floats, remembered: int) -> None:
        self._numbers = numbers
        self._memory = np.zeros(remembered)

    @abstractmethod
    def _inspect(self, values: Floats, accept: bool) -> int:
        """Judge a tick: the worst state's number, -1 if there is no alarm. The score is left in the memory.

        If ``accept``, a tick that passes becomes the predecessor of the next.
        """

    def check(self, stage: str, values: Floats) -> Alarm | None:
        """Judge one tick of control; other stages have no alarm."""
        if stage != STAGE:
            return None
        found = self._inspect(values, True)
        if found < 0:
            return None
        return Alarm(stage, self.states[found], self.alarmed_row, float(self._memory[SCORE]))

    def score(self, stage: str, values: Floats) -> float:
        """The score of one tick of control; 0 for other stages."""
        if stage != STAGE:
            return 0.0
        self._inspect(values, False)
        return float(self._memory[SCORE])

    def reset(self, stage: str) -> None:
        """Forget the ticks before: the next one has no predecessor."""
        if stage == STAGE:
            self._memory[:] = 0.0
