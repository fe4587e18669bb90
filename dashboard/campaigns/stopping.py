"""When a campaign knows enough: looks fixed in advance, each at every cell's success."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from dashboard.campaigns.spec import Cell, Stop
from dashboard.campaigns.statistics.proportions import wilson

ERROR = 0.05
"""Of all looks together (Bonferroni): a study that stops early because of what it saw must not claim more."""


class StoppingRule:
    """Releases runs look by look. Without a ``stop`` all are released at once."""

    def __init__(self, stop: Stop | None, runs_per_cell: Iterable[Cell], runs: int) -> None:
        self._planned = Counter(runs_per_cell)
        self._margin = stop.margin if stop is not None else 0.0
        self._looks = (*(stop.looks if stop is not None else ()), runs)
        self._look = 0
        self._flown: Counter[Cell] = Counter()
        self._successes: Counter[Cell] = Counter()

    @property
    def released(self) -> int:
        """Runs with a smaller number may fly."""
        return self._looks[self._look]

    def add(self, cell: Cell, *, success: bool) -> None:
        """Take in a flight."""
        self._flown[cell] += 1
        self._successes[cell] += success

    def look(self) -> bool:
        """Everything released has ended: whether that is enough. If not, the next runs are released."""
        if self._look == len(self._looks) - 1 or self._enough():
            return True
        self._look += 1
        return False

    def _enough(self) -> bool:
        level = 1 - ERROR / len(self._looks)
        return all(
            # A cell that can fly no more cannot become any narrower.
            planned <= self.released
            or wilson(self._successes[cell], self._flown[cell], level).width <= 2 * self._margin
            for cell, planned in self._planned.items()
        )
