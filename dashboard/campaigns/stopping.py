"""When a campaign knows enough: looks fixed in advance, each at every cell's success."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from dashboard.campaigns.spec import Cell, StoppingSpec
from dashboard.campaigns.statistics.proportions import wilson

ERROR = 0.05
"""Of all looks together (Bonferroni): a study that stops early because of what it saw must not claim more."""


class StoppingRule:
    """Releases runs look by look. Without a ``stop`` all are released at once."""

    def __init__(self, stop: StoppingSpec | None, runs_per_cell: Iterable[Cell], runs: int) -> None:
        self._planned = Counter(runs_per_cell)
        self._margin = stop.margin if stop is not None else 0.0
        self._looks = (*(stop.looks if stop is not None else ()), runs)
        self._look = 0
        self._flown: dict[Cell, dict[int, bool]] = {cell: {} for cell in self._planned}

    @property
    def released(self) -> int:
        """Runs with a smaller number may fly."""
        return self._looks[self._look]

    def add(self, cell: Cell, number: int, *, success: bool) -> None:
        """Take in a flight, of now or of before an interruption."""
        self._flown[cell][number] = success

    def look(self) -> bool:
        """Everything released has ended: whether that is enough. If not, the next runs are released."""
        if self._look == len(self._looks) - 1 or self._enough():
            return True
        self._look += 1
        return False

    def _enough(self) -> bool:
        # A cell that can fly no more cannot become any narrower.
        return all(
            planned <= self.released or self._is_narrow(cell) for cell, planned in self._planned.items()
        )

    def _is_narrow(self, cell: Cell) -> bool:
        # A resumed campaign may know flights beyond this look: they must not sway it.
        seen = [success for number, success in self._flown[cell].items() if number < self.released]
        level = 1 - ERROR / len(self._looks)
        return wilson(sum(seen), len(seen), level).width <= 2 * self._margin
