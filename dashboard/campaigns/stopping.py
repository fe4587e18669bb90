"""When a campaign knows enough: looks fixed in advance, each at every cell's rate of failure or harm."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from dashboard.campaigns.spec import Cell, Run, StoppingSpec
from dashboard.campaigns.statistics.proportions import wilson

ERROR = 0.05
"""Of all looks together (Bonferroni): a study that stops early because of what it saw must not claim more."""


class StoppingRule:
    """Releases runs look by look. Without a ``stop`` all are released at once."""

    def __init__(self, stop: StoppingSpec | None, planned: Iterable[Run], runs: int) -> None:
        golden_counts = stop is None or stop.of == "failure"
        self._planned = Counter(run.cell for run in planned if golden_counts or run.spec.fault is not None)
        self._stop = stop
        self._looks = (*(stop.looks if stop is not None else ()), runs)
        self._look = 0
        self._flown: dict[Cell, dict[int, bool]] = {cell: {} for cell in self._planned}

    @property
    def released(self) -> int:
        """Runs with a smaller number may fly."""
        return self._looks[self._look]

    def add(self, cell: Cell, number: int, *, success: bool, harm: bool | None = None) -> None:
        """Take in a flight, of now or of before an interruption; ``harm`` is None if it cannot be judged."""
        event = harm if self._stop is not None and self._stop.of == "harm" else not success
        if event is not None and cell in self._flown:
            self._flown[cell][number] = event

    def look(self) -> bool:
        """Everything released has ended: whether that is enough. If not, the next runs are released."""
        if self._look == len(self._looks) - 1 or self._enough():
            return True
        self._look += 1
        return False

    def _enough(self) -> bool:
        # A cell that can fly no more cannot become any narrower.
        return all(
            planned <= self.released or self._is_known(cell, self._stop)
            for cell, planned in self._planned.items()
            if self._stop is not None
        )

    def _is_known(self, cell: Cell, stop: StoppingSpec) -> bool:
        # A resumed campaign may know flights beyond this look: they must not sway it.
        seen = [event for number, event in self._flown[cell].items() if number < self.released]
        margin = stop.margin
        if margin is None:
            margin = (stop.relative or 0.0) * sum(seen) / max(len(seen), 1)
        level = 1 - ERROR / len(self._looks)
        return wilson(sum(seen), len(seen), level).width <= 2 * margin
