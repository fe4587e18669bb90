"""How much harm detectors catch in time: as a table, as JSON and as a page of results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from dashboard.campaigns.statistics.proportions import clopper_pearson, lower_bound
from deploy.config.platform import load_platform
from deploy.errors import BadSpecError
from detector.evaluation.coverage import Coverage, FaultVerdict, JudgedFlight, at_budget
from detector.series.series import Series
from services.recovery.reexecution import SCHEME as REEXECUTION

KEYS = {"pilot": "pilot", "class": "fault_class", "struck": "target", "led to harm": "cause"}
"""What faults are grouped by: the heads of columns, and the fields of their reports."""

BOUNDS = (0.95, 0.99)
"""Levels of the one-sided lower bounds of coverage."""

_RECORD = "zenfi detect record harmful.jsonl --output DIR"
_LEGEND = (
    "Of the faults that harm a mission, how many does a detector notice before the harm, and at how many\n"
    "false alarms? All schemes have the same budgets: each other golden flight sets the limit of the score,\n"
    "the rest tell the false alarms, at most one a flight. Bounds of what is caught are one-sided,\n"
    "intervals of false alarms two-sided (Clopper-Pearson by flight, Poisson by time). Times are medians,\n"
    "with the tenth and the ninetieth percentile: from the fault to the alarm, and from the alarm to the\n"
    "harm. Compute is virtual time on the flights' platform; that of re-execution is the kernels' second\n"
    "run."
)
_CAUSES = (
    "Data: the stage went on with wrong data. Crash and hang: it died or hung, of which a supervisor hears\n"
    "at once; a detector hears only of what is wrong before. Of faults that stay, re-execution finds what a\n"
    "copy finds that the fault does not strike, as on a second unit; on the same one both would be wrong\n"
    "alike."
)
_HEADS = (
    "scheme",
    "budget",
    "limit",
    "false alarms",
    "a flight",
    "in 100 h",
    "caught in time",
    "%",
    "> 95 %",
    "> 99 %",
    "alarm after, s",
    "margin, s",
    "compute, % of the time",
)


class Budget(NamedTuple):
    """How many false alarms are allowed, in words and as numbers."""

    words: str
    per_flight: float
    per_hour: float

    def coverage(self, flights: Sequence[JudgedFlight]) -> Coverage:
        """What a detector finds within the budget."""
        return at_budget(flights, self.per_flight, self.per_hour)


BUDGETS = (Budget("0.1 a flight", 0.1, 0.0), Budget("1 in 100 h", 0.0, 0.01))


@dataclass(frozen=True, slots=True)
class SchemeCoverage:
    """A scheme, and what it finds within each budget.

    ``compute_share`` is the virtual time that it takes, as a part of the missions' time; None if their
    platform does not say.
    """

    scheme: str
    compute_share: float | None
    at: Sequence[tuple[Budget, Coverage]]


def compute_share(scheme: str, flights: Sequence[Series]) -> float | None:
    """The virtual time that a scheme takes in golden flights, as a part of theirs; None if nobody knows.

    Re-execution takes that of the kernels, the others that of their checks on the flights' platform.
    """
    golden = [one for one in flights if "harm" not in one.about]
    took_s = [_compute_s(scheme, one) for one in golden]
    known_s = [one for one in took_s if one is not None]
    if len(known_s) < len(took_s):
        return None
    return sum(known_s) / max(sum(float(one.about["time_s"]) for one in golden), 1e-9)


def _compute_s(scheme: str, flight: Series) -> float | None:
    if scheme == REEXECUTION:
        return float(flight.about["kernels_s"])
    check = load_platform(flight.spec.platform).detectors.get(scheme)
    return None if check is None else check.mean_ms / 1e3 * sum(map(len, flight.checks.values()))


def events_interval(events: int, level: float = 0.95) -> tuple[float, float]:
    """The exact two-sided interval of the mean of a Poisson count (Garwood 1936)."""
    alpha = 1 - level
    low = scipy.stats.chi2.ppf(alpha / 2, 2 * events) / 2 if events else 0.0
    return float(low), float(scipy.stats.chi2.ppf(1 - alpha / 2, 2 * events + 2) / 2)


def as_dict(one: SchemeCoverage) -> dict[str, Any]:
    """Every figure, as JSON can hold it."""
    budgets = [_figures(budget, found) for budget, found in one.at]
    return {"scheme": one.scheme, "compute_share": one.compute_share, "budgets": budgets}


def _figures(budget: Budget, found: Coverage) -> dict[str, Any]:
    hours = max(found.hours, 1e-9)
    faults = len(found.verdicts)
    return {
        "budget": budget.words,
        "limit": found.limit if np.isfinite(found.limit) else None,
        "golden_flights": found.flights,
        "golden_hours": round(found.hours, 3),
        "false_alarms": found.alarms,
        "false_alarms_per_flight": [
            found.alarms / max(found.flights, 1),
            *clopper_pearson(found.alarms, found.flights),
        ],
        "false_alarms_per_100_h": [
            100 * one / hours for one in (found.alarms, *events_interval(found.alarms))
        ],
        "harmful": faults,
        "caught_in_time": found.in_time,
        "bounds": {str(level): lower_bound(found.in_time, faults, level) for level in BOUNDS},
        "faults": [
            {**one.harm.model_dump(), "alarm_s": one.alarm_s, "in_time": one.in_time}
            for one in found.verdicts
        ],
    }


def show(console: Console, found: Sequence[SchemeCoverage]) -> None:
    """Print what each scheme catches within each budget, then by class of fault."""
    heads = ("scheme", "false alarms", "in flights", "caught in time", "%", "> 95 %", "margin, s")
    for number, budget in enumerate(BUDGETS):
        rows = [_short_row(one, one.at[number][1]) for one in found]
        title = f"harmful faults caught before they harm, at {budget.words}"
        console.print(_table(title, heads, rows, left=1))
    title = f"caught in time, at {BUDGETS[0].words}"
    keys = ("class", "struck")
    console.print(_table(title, *_by(keys, found), left=len(keys)))


def _table(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], left: int) -> Table:
    table = Table(box=SIMPLE, pad_edge=False, collapse_padding=True, title=title)
    for number, name in enumerate(heads):
        table.add_column(name, justify="left" if number < left else "right")
    for row in rows:
        table.add_row(*row)
    return table


def ranked(found: Sequence[SchemeCoverage]) -> list[SchemeCoverage]:
    """The schemes by what they catch in time at each budget, the best first; then by their names."""
    return sorted(found, key=lambda one: ([-caught.in_time for _, caught in one.at], one.scheme))


def write(
    path: Path, found: Sequence[SchemeCoverage], command: str, title: str = "Detectors, judged on harm"
) -> None:
    """Write the page of results that ``command`` makes.

    :raises BadSpecError: if the file cannot be written.
    """
    golden = found[0].at[0][1]
    counted = f"{len(golden.verdicts)} harmful faults, {golden.flights} golden flights ({golden.hours:.1f} h)"
    parts = [
        f"# {title}",
        _LEGEND,
        f"```\nzenfi harm collect LABEL --output harmful.jsonl\n{_RECORD}\n{command}\n```",
        f"{counted} that set no limit.",
        _markdown(_HEADS, _rows(found)),
        f"## By what led to the harm, {BUDGETS[0].words}",
        _CAUSES,
        _markdown(*_by(("led to harm",), found)),
        f"## By what was struck, {BUDGETS[0].words}",
        _markdown(*_by(("pilot", "class", "struck", "led to harm"), found)),
    ]
    try:
        path.write_text("\n\n".join(parts) + "\n")
    except OSError as error:
        message = f"{path}: {error.strerror}"
        raise BadSpecError(message) from error


def _markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _rows(found: Sequence[SchemeCoverage]) -> list[list[str]]:
    rows = [_row(one, budget.words, coverage) for one in found for budget, coverage in one.at]
    faults = len(found[0].at[0][1].verdicts) if found else 0
    return [["none", "", "", "0", "0", "0", f"0 of {faults}", "0", "0", "0", "", "", "0"], *rows]


def _row(one: SchemeCoverage, budget: str, found: Coverage) -> list[str]:
    figures = _figures(Budget(budget, 0.0, 0.0), found)
    faults = len(found.verdicts)
    caught = [that for that in found.verdicts if that.in_time]
    delays = [that.alarm_s - that.harm.injected_s for that in caught if that.alarm_s is not None]
    margins = [that.margin_s for that in caught if that.margin_s is not None]
    return [
        one.scheme,
        budget,
        f"{found.limit:.3g}",
        str(found.alarms),
        _with_ends(*figures["false_alarms_per_flight"]),
        _with_ends(*figures["false_alarms_per_100_h"]),
        f"{found.in_time} of {faults}",
        f"{100 * found.in_time / max(faults, 1):.1f}",
        *(f"{100 * lower_bound(found.in_time, faults, level):.1f}" for level in BOUNDS),
        _quantiles(delays),
        _quantiles(margins),
        "unknown" if one.compute_share is None else f"{100 * one.compute_share:.2g}",
    ]


def _short_row(one: SchemeCoverage, found: Coverage) -> list[str]:
    row = dict(zip(_HEADS, _row(one, "", found), strict=True))
    shown = [row[name] for name in ("caught in time", "%", "> 95 %", "margin, s")]
    return [one.scheme, str(found.alarms), str(found.flights), *shown]


def _with_ends(value: float, low: float, high: float) -> str:
    return f"{value:.3g} ({low:.2g} to {high:.2g})"


def _quantiles(values: Sequence[float]) -> str:
    """The median, and a tenth and nine tenths."""
    if not values:
        return ""
    low, middle, high = np.quantile(values, (0.1, 0.5, 0.9))
    return f"{middle:.1f} ({low:.1f} to {high:.1f})"


def _by(keys: Sequence[str], found: Sequence[SchemeCoverage]) -> tuple[list[str], list[list[str]]]:
    """A row for each combination of some keys: how many faults there are, and how many each scheme caught."""
    verdicts = [one.at[0][1].verdicts for one in found]
    heads = [*keys, "faults", *(one.scheme for one in found)]
    every = sorted({_key(one, keys) for one in verdicts[0]}) if verdicts else []
    return heads, [[*key, *_counted(verdicts, keys, key)] for key in every]


def _key(one: FaultVerdict, keys: Sequence[str]) -> tuple[str, ...]:
    return tuple(str(getattr(one.harm, KEYS[name])) for name in keys)


def _counted(
    verdicts: Sequence[Sequence[FaultVerdict]], keys: Sequence[str], key: tuple[str, ...]
) -> Iterator[str]:
    those = [[one for one in of_scheme if _key(one, keys) == key] for of_scheme in verdicts]
    yield str(len(those[0]))
    for of_scheme in those:
        yield str(sum(one.in_time for one in of_scheme))
