"""A campaign's results as a page of Markdown: cells beside what they are compared with, by fault."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path

from dashboard.campaigns.results.compare import Comparison, Difference
from dashboard.campaigns.results.summary import CellSummary
from dashboard.campaigns.spec import Cell
from dashboard.campaigns.statistics.proportions import Interval
from dashboard.campaigns.store.queries import CampaignEntry
from deploy.errors import BadSpecError

_HEAD = (
    "| arm | flown | struck | success % | change, points | p | time, s | time p95, s | energy, kJ |\n"
    "|---|---|---|---|---|---|---|---|---|"
)
_LEGEND = (
    "Flown: flights that have a result. Struck: of these, the fault was there when read back. Success with\n"
    "its Wilson interval. All else is beside {reference}: change of success with its Newcombe interval;\n"
    "p of McNemar's exact test, Holm-adjusted over all rows of the page; time and energy as the median of\n"
    "the paired difference over the pairs that both arrived, time also as its 95th percentile, with\n"
    "bootstrap intervals. All intervals are of 95 %."
)


def write(
    path: Path,
    found: CampaignEntry,
    lines: Sequence[CellSummary],
    compared: Sequence[Comparison],
    command: str,
) -> None:
    """Write the page of a campaign, which ``command`` makes again.

    :raises BadSpecError: if the file cannot be written.
    """
    try:
        path.write_text(page(found, lines, compared, command))
    except OSError as error:
        message = f"{path}: {error.strerror}"
        raise BadSpecError(message) from error


def page(
    found: CampaignEntry, lines: Sequence[CellSummary], compared: Sequence[Comparison], command: str
) -> str:
    """The page: what was flown, then a table for each world and fault with a row for each arm."""
    spec = found.spec
    flown = sum(line.runs - line.failed_to_fly for line in lines)
    failed = sum(line.failed_to_fly for line in lines)
    last = spec.mission.seed + (spec.seeds or spec.runs) - 1
    about = f"{flown} flights, seeds {spec.mission.seed} to {last}; {failed} could not be flown."
    parts = [f"# Campaign {spec.name}", f"{about} Made by `{command}`.", *tables(lines, compared)]
    return "\n\n".join(parts) + "\n"


def tables(lines: Sequence[CellSummary], compared: Sequence[Comparison]) -> Iterator[str]:
    """What the columns are, then a table for each world and fault with a row for each arm."""
    beside = {one.cell: one for one in compared}
    yield _LEGEND.format(reference=compared[0].reference if compared else "nothing")
    ordered = sorted(lines, key=lambda line: (line.world, line.fault))
    for (world, fault), cells in groupby(ordered, key=lambda line: (line.world, line.fault)):
        yield f"## {world}{': ' if fault else ''}{fault}"
        yield "\n".join([_HEAD, *_rows(cells, beside)])


def _rows(lines: Iterator[CellSummary], beside: Mapping[str, Comparison]) -> Iterator[str]:
    for line in lines:
        flown = line.runs - line.failed_to_fly
        rate = f"{100 * line.successes / flown:.0f} " if flown else "- "
        success = rate + _between(Interval(line.success_low, line.success_high), 100, "")
        told = [line.arm, str(flown), str(line.injected) if line.aimed else "", success]
        one = beside.get(str(Cell(line.arm, line.world, line.fault)))
        yield f"| {' | '.join([*told, *_compared(one)])} |"


def _compared(one: Comparison | None) -> list[str]:
    if one is None or one.success_difference is None:
        return [""] * 5
    return [
        f"{100 * one.success_difference:+.0f} {_between(one.success_interval, 100, '+')}",
        f"{one.p_adjusted:.2g}",
        _quantile(one.flight_time_s.median, one.flight_time_s.median_interval),
        _quantile(one.flight_time_s.p95, one.flight_time_s.p95_interval),
        _median(one.energy_kj),
    ]


def _median(difference: Difference) -> str:
    return _quantile(difference.median, difference.median_interval)


def _quantile(value: float | None, interval: Interval | None) -> str:
    if value is None:
        return ""
    return f"{value:+.1f}" if interval is None else f"{value:+.1f} {_between(interval, 1, '+')}"


def _between(interval: Interval, scale: float, sign: str) -> str:
    digits = 0 if scale > 1 else 1
    return f"({scale * interval.low:{sign}.{digits}f} to {scale * interval.high:{sign}.{digits}f})"
