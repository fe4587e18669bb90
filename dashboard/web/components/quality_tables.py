"""Tables of quality of flight and of paired differences, in words for people."""

from __future__ import annotations

from collections.abc import Sequence

from nicegui import ui

from dashboard.campaigns.results.compare import Comparison, Difference
from dashboard.campaigns.results.summary import CellSummary
from dashboard.campaigns.spec import Cell
from dashboard.campaigns.statistics.proportions import Interval

Row = dict[str, object]

QUALITY_NOTE = (
    "In brackets 95 % intervals: Wilson's of success; order statistics of the medians of time, distance and "
    "energy of the successful flights, from six on. Hit: the fault was there when read back, of the flights "
    "that were to have one."
)
BESIDE_NOTE = (
    "Differences are the arm's less the reference's, of flights of the same seed. Success: change in points "
    "with Newcombe's paired 95 % interval, p of the exact McNemar test, Holm-adjusted. Time, distance and "
    "energy: median of the paired difference where both arrived, with its bootstrap 95 % interval."
)


def short(cells: Sequence[Cell]) -> list[str]:
    """What tells the cells apart: the names that are the same everywhere are left out."""
    apart = [i for i in range(3) if len({cell[i] for cell in cells}) > 1] or [0]
    return [" / ".join(cell[i] for i in apart if cell[i]) for cell in cells]


def table(columns: Sequence[tuple[str, str]], rows: Sequence[Row] = ()) -> ui.table:
    """A table of text; the first column names the row."""
    made = ui.table(
        columns=[
            {"name": name, "label": label, "field": name, "align": "left" if i == 0 else "right"}
            for i, (name, label) in enumerate(columns)
        ],
        rows=list(rows),
        row_key=columns[0][0],
    )
    return made.props("flat dense hide-pagination :rows-per-page-options=[0]").classes("figures")


def quality_table() -> ui.table:
    """Quality of flight, a row per cell."""
    return table(
        (
            ("cell", "arm"),
            ("flown", "flown"),
            ("success", "success, %"),
            ("time", "time, s"),
            ("distance", "distance, m"),
            ("energy", "energy, kJ"),
            ("per_success", "kJ per success"),
            ("replans", "replans"),
            ("hit", "hit"),
            ("harm", "harm"),
            ("nodes", "injected node"),
            ("effects", "detector"),
        )
    )


def quality_rows(summary: Sequence[CellSummary]) -> list[Row]:
    """The rows of :func:`quality_table`."""
    labels = short([Cell(one.arm, one.world, one.fault) for one in summary])
    return [_quality(label, one) for label, one in zip(labels, summary, strict=True)]


def _quality(label: str, one: CellSummary) -> Row:
    flown = one.runs - one.failed_to_fly
    success = (
        f"{100 * one.successes / flown:.0f} ({_range(one.success_low, one.success_high)})" if flown else "-"
    )
    return {
        "cell": label,
        "flown": f"{flown} of {one.planned}"
        + (f", {one.proven} proven" if one.proven else "")
        + (f", {one.failed_to_fly} could not" if one.failed_to_fly else ""),
        "success": success,
        "time": _between(one.flight_time_s, one.flight_time_low_s, one.flight_time_high_s),
        "distance": _between(one.distance_m, one.distance_low_m, one.distance_high_m),
        "energy": _between(one.energy_kj, one.energy_low_kj, one.energy_high_kj),
        "per_success": _number(one.energy_per_success_kj),
        "replans": _number(one.replans),
        "hit": f"{one.injected} of {one.aimed}" if one.aimed else "-",
        "harm": "-" if one.harmed is None else str(one.harmed),
        "nodes": ", ".join(f"{count} {name}" for name, count in one.results.items()) or "-",
        "effects": ", ".join(f"{count} {word}" for word, count in one.effects.items() if count) or "-",
    }


def beside_table() -> ui.table:
    """Cells beside their reference."""
    return table(
        (
            ("cell", "arm"),
            ("pairs", "pairs"),
            ("success", "successes, reference's"),
            ("change", "change, points"),
            ("p", "p"),
            ("time", "time, s"),
            ("p95", "time, s, 95th percentile"),
            ("distance", "distance, m"),
            ("energy", "energy, kJ"),
        )
    )


def beside_rows(compared: Sequence[Comparison]) -> list[Row]:
    """The rows of :func:`beside_table`."""
    return [
        {
            "cell": one.cell,
            "pairs": one.pairs,
            "success": f"{one.successes}, {one.reference_successes}",
            "change": _signed(one.success_difference, one.success_interval, 100, 0),
            "p": f"{one.p_adjusted:.2g}",
            "time": _median(one.flight_time_s),
            "p95": _signed(one.flight_time_s.p95, one.flight_time_s.p95_interval),
            "distance": _median(one.distance_m),
            "energy": _median(one.energy_kj),
        }
        for one in compared
    ]


def _median(difference: Difference) -> str:
    return _signed(difference.median, difference.median_interval)


def _signed(value: float | None, interval: Interval | None, scale: float = 1, digits: int = 1) -> str:
    if value is None:
        return "-"
    # The z takes the sign from what rounds to nothing.
    told, *ends = (f"{scale * one:+z.{digits}f}" for one in (value, *(interval or ())))
    return f"{told} ({' to '.join(ends)})" if ends else told


def _range(low: float, high: float) -> str:
    return f"{100 * low:.0f} to {100 * high:.0f}"


def _between(value: float | None, low: float | None, high: float | None) -> str:
    return _number(value) if low is None or high is None else f"{value:.1f} ({low:.1f} to {high:.1f})"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
