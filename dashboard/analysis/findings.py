"""What a campaign has found, in a sentence for each cell: the effect, its interval, and if it is resolved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dashboard.campaigns.results.compare import Comparison
from dashboard.campaigns.results.summary import CellSummary
from dashboard.campaigns.spec import Cell
from dashboard.campaigns.statistics.sampling import resolvable_drop

SIGNIFICANT = 0.05
"""Of p-values adjusted for all cells that are compared."""


def findings(lines: Sequence[CellSummary], compared: Sequence[Comparison]) -> list[str]:
    """A sentence for each cell, in the order of the campaign."""
    beside: Mapping[str, Comparison] = {one.cell: one for one in compared}
    return [finding(line, beside.get(str(Cell(line.arm, line.world, line.fault)))) for line in lines]


def finding(line: CellSummary, beside: Comparison | None) -> str:
    """What was found of a cell, and whether its difference from what it is compared with is resolved."""
    name = ", ".join(filter(None, (line.arm, line.world, line.fault)))
    flown = line.runs - line.failed_to_fly
    if not flown:
        return f"{name}: nothing is flown yet."
    between = f"{100 * line.success_low:.0f} to {100 * line.success_high:.0f} %"
    told = f"{name}: {line.successes} of {flown} missions succeeded ({between})"
    if line.harmed is not None:
        told += f", {line.harmed} of {line.injected} faults harmed"
    if beside is None or beside.success_difference is None:
        return f"{told}."
    return f"{told}. {_effect(beside)}"


def _effect(beside: Comparison) -> str:
    points = 100 * (beside.success_difference or 0.0)
    low, high = (100 * end for end in beside.success_interval)
    between = f"({low:+z.0f} to {high:+z.0f}, p {beside.p_adjusted:.2g})"
    told = f"{points:+z.0f} points beside {beside.reference} {between}"
    if beside.p_adjusted < SIGNIFICANT:
        return f"{'Success falls' if points < 0 else 'Success rises'}: {told}."
    rate = beside.reference_successes / beside.pairs if beside.pairs else 0.0
    drop = resolvable_drop(beside.pairs, rate) if rate > 0 else None
    pairs = "" if drop is None else f"; {beside.pairs} pairs tell a drop of {100 * drop:.0f} points or more"
    return f"No difference is resolved: {told}{pairs}."
