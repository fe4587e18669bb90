"""What the page of a campaign shows of its figures, made once: every page that looks is sent the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import orjson

from dashboard.campaigns.results.injection_groups import BETWEEN, TARGET, InjectionGroup, InjectionTable
from dashboard.campaigns.results.summary import CellSummary
from dashboard.campaigns.statistics.proportions import wilson
from dashboard.web.charts import charts
from dashboard.web.charts.figures import CellFlights, Figures
from dashboard.web.components.quality_tables import Row, quality_rows, short

MOST_GROUPS = 20
QUALITY_TITLES = ("flight time, s", "flight distance, m", "energy, kJ")
BIT = "bit"

FAILURES: dict[str, Callable[[InjectionGroup], int]] = {
    "missions failed": lambda group: group.failed,
    "nodes crashed or hung": lambda group: group.results.get("crash", 0) + group.results.get("hang", 0),
    "nodes silently wrong (sdc)": lambda group: group.results.get("sdc", 0),
}
"""What can have gone wrong, and in how many flights of a group it did."""


class FindingsChart(NamedTuple):
    """Options as they are sent, and how many rows they have. Equal options are the same object."""

    options: orjson.Fragment
    rows: int

    @classmethod
    def of(cls, options: charts.Options, rows: int) -> FindingsChart:
        """Made ready once: NiceGUI would wrap every value of options, and write them out for each page."""
        return cls(_sent(orjson.dumps(options)), rows)


@lru_cache(maxsize=64)
def _sent(text: bytes) -> orjson.Fragment:
    return orjson.Fragment(text)


class Groups(NamedTuple):
    """The largest groups of injected flights, and how many more there are."""

    rows: list[Row]
    left: int


@dataclass(frozen=True, slots=True)
class Findings:
    """What was found so far; ``boxes`` in the order of :data:`QUALITY_TITLES`, ``nodes`` if any."""

    quality: list[Row]
    success: FindingsChart
    outcomes: FindingsChart
    nodes: FindingsChart | None
    boxes: list[FindingsChart]
    sampled: str

    @classmethod
    def of(cls, figures: Figures) -> Findings:
        """Words and charts of figures."""
        labels = short([one.cell for one in figures.flights])
        rows = len(labels)
        successes = [_success(label, one) for label, one in zip(labels, figures.summary, strict=True)]
        about = "Success per arm with 95 % intervals; the table above has the numbers"
        success = charts.shares(successes, charts.GREEN, "missions that succeeded, %", about)
        counts = [one.results for one in figures.flights]
        outcomes = charts.stacked(labels, counts, "missions, %", "What became of missions, per arm")
        boxes = [_boxed(labels, figures.flights, i, title) for i, title in enumerate(QUALITY_TITLES)]
        drawn, flown = (sum(n) for n in zip(*((len(c.dots), c.flown) for c in figures.flights), strict=True))
        told = f"{drawn} of {flown} flights are drawn as dots, evenly chosen; boxes have all."
        return cls(
            quality_rows(figures.summary),
            FindingsChart.of(success, rows),
            FindingsChart.of(outcomes, rows),
            _nodes(labels, figures.summary),
            [FindingsChart.of(options, 3 * rows // 2) for options in boxes],
            told if drawn < flown else "",
        )


@dataclass(slots=True)
class InjectionFindings:
    """The injected flights of a campaign, grouped and drawn."""

    flights: InjectionTable | None = None
    _heats: dict[str, FindingsChart] = field(init=False, default_factory=dict)
    _groups: dict[str, Groups] = field(init=False, default_factory=dict)

    def heat(self, failure: str) -> FindingsChart | None:
        """The map of one of :data:`FAILURES`, made when first asked for; None if nothing was injected."""
        if self.flights and failure not in self._heats:
            self._heats[failure] = _heat(self.flights, failure)
        return self._heats.get(failure)

    def groups(self, name: str) -> Groups:
        """The injected flights by one of :data:`WAYS`, put together when first asked for."""
        if name not in self._groups:
            # A message that was corrupted has bits, but neither register nor instruction.
            groups = self.flights.grouped(name, of_kernels=name != BIT) if self.flights is not None else []
            rows = [_group(group) for group in groups[:MOST_GROUPS]]
            self._groups[name] = Groups(rows, len(groups) - len(rows))
        return self._groups[name]


def _success(label: str, one: CellSummary) -> charts.ChartPart:
    flown = one.runs - one.failed_to_fly
    return charts.ChartPart(label, one.successes, flown, one.success_low, one.success_high)


def _boxed(labels: Sequence[str], flights: Sequence[CellFlights], which: int, title: str) -> charts.Options:
    dots = [
        charts.ChartPoint(
            row,
            dot.values[which],
            dot.success,
            f"{label}, run {dot.number}: {dot.values[which]:.1f}" + ("" if dot.success else ", failed"),
            dot.run,
        )
        for row, (label, one) in enumerate(zip(labels, flights, strict=True))
        for dot in one.dots
    ]
    fives = [one.boxes[which] if one.boxes is not None else None for one in flights]
    return charts.boxes(
        labels, fives, dots, title, f"Boxes of {title}, per arm; the runs below have the numbers"
    )


def _nodes(labels: Sequence[str], summary: Sequence[CellSummary]) -> FindingsChart | None:
    injected = [(label, one.results) for label, one in zip(labels, summary, strict=True) if one.injected]
    if not injected:
        return None
    hit, results = zip(*injected, strict=True)
    about = "Outcome of the injected nodes, per arm; the table above has the numbers"
    return FindingsChart.of(charts.stacked(hit, results, "injected nodes, %", about), len(hit))


def _heat(flights: InjectionTable, failure: str) -> FindingsChart:
    found = {}
    for group in flights.grouped(BIT, TARGET):
        bit, _, target = group.name.partition(BETWEEN)
        found[bit, target] = FAILURES[failure](group), group.injected
    across = sorted({bit for bit, _ in found}, key=_first)
    down = sorted({target for _, target in found})
    about = f"{failure}, by the bits and the kernel or state that were corrupted; the table below has groups"
    return FindingsChart.of(charts.heat_map(across, down, found, failure, about), len(down) + 1)


def _first(bits: str) -> tuple[bool, int]:
    several = bits.endswith("bits")
    return several, int(bits.partition(" " if several else "-")[0])


def _group(group: InjectionGroup) -> Row:
    parts = {name: _part(count(group), group.injected) for name, count in FAILURES.items()}
    return {"name": group.name, "injected": group.injected} | parts


def _part(count: int, injected: int) -> str:
    low, high = wilson(count, injected)
    return f"{100 * count / injected:.0f} ({100 * low:.0f} to {100 * high:.0f})"
