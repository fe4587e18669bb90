"""What became of struck kernels and programs: shares with intervals, in words and as bars, in groups."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence

from nicegui import ui

from dashboard.analysis.kernel_study import PROGRAM_RESULTS, WAYS, OutcomeShare
from dashboard.api.routes.program_studies import StudyGroup
from dashboard.web.charts import charts
from dashboard.web.components.breakdown import draw, fill
from dashboard.web.components.frame import told
from dashboard.web.components.quality_tables import Row, table

MOST_GROUPS = 20
CHARTED = 10
"""Of the groups, the largest."""

LONGEST = 40
"""Characters of a name in a chart; the table has it in full."""


def in_words(shares: Mapping[str, OutcomeShare]) -> Row:
    """Each share in per cent, with its interval."""
    total = max(sum(share.count for share in shares.values()), 1)
    return {
        name: f"{100 * share.count / total:.1f} ({100 * share.low:.1f} to {100 * share.high:.1f})"
        for name, share in shares.items()
    }


def counts(shares: Mapping[str, OutcomeShare]) -> dict[str, int]:
    """How many there are of each outcome."""
    return {name: share.count for name, share in shares.items()}


class OutcomeGroups:
    """The outcomes divided by what was struck: a choice of the way, bars and a table.

    ``groups_by`` tells the groups by a way; :meth:`refresh` shows the newest.
    """

    def __init__(self, groups_by: Callable[[str], Awaitable[Sequence[StudyGroup]]]) -> None:
        self._groups_by = groups_by
        with ui.row().classes("toolbar"):
            ui.label("by")
            self._way = ui.toggle(list(WAYS), value="register", on_change=told(self.refresh))
            self._way.props('no-caps unelevated aria-label="Divide by"').classes("ways-toggle")
        self._chart = ui.echart({}).classes("chart")
        columns = (("name", "what"), ("injected", "injected"))
        self._table = table((*columns, *((name, f"{name}, % (95 %)") for name in PROGRAM_RESULTS)))
        self._more = ui.label().classes("note")

    async def refresh(self) -> None:
        """Show the newest groups by the chosen way."""
        way = str(self._way.value)
        groups = await self._groups_by(way)
        if way != self._way.value:
            return  # another way was chosen meanwhile
        largest = groups[:CHARTED]
        words = f"Outcomes by {way}, of the injected, per cent; the table below has the numbers"
        labels = [_short(f"{one.name} ({one.injected})") for one in largest]
        found = [counts(one.shares) for one in largest]
        draw(self._chart, charts.stacked(labels, found, "of the injected, %", words), len(largest))
        fill(
            self._table,
            [
                {"name": one.name, "injected": one.injected} | in_words(one.shares)
                for one in groups[:MOST_GROUPS]
            ],
        )
        left = len(groups) - MOST_GROUPS
        self._more.set_text(f"{left} more groups, each with fewer injections, are not shown.")
        self._more.set_visibility(left > 0)


def _short(name: str) -> str:
    return name if len(name) <= LONGEST else f"{name[: LONGEST // 2]}…{name[-LONGEST // 2 :]}"
