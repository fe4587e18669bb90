"""What an evaluation of a detector came to: as a table and as JSON."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from detector.evaluation.evaluation import MUST_HOLD, Evaluation, Tally


def as_dict(result: Evaluation) -> dict[str, Any]:
    """Every figure, as JSON can hold it."""
    return {
        "golden_flights": result.flights,
        "golden_flight_s": round(result.seconds, 2),
        "checks": result.checks,
        "false_alarms": result.alarms,
        "flights_with_false_alarm": result.flights_alarmed,
        "false_alarms_per_flight": _figure(result.alarms_per_flight),
        "false_alarms_per_hour": _figure(result.alarms_per_hour),
        "false_alarms_by_state": dict(sorted(result.alarmed_states.items())),
        "confusion": result.confusion(),
        "beyond_largest": _tally(_beyond(result)),
        "roc_area": _figure(result.area()),
        "roc": [
            {"limit": round(limit, 4), "false_alarms_per_flight": round(false, 5), "found": _figure(found)}
            for limit, false, found in result.roc()
        ],
        "states": [
            {
                "state": state,
                "field": field,
                **_tally(tally),
                "missed_by_median": tally.missed(0.5),
                "missed_by_p95": tally.missed(0.95),
            }
            for (state, field), tally in result.fields.items()
        ],
        "beyond_by_state": {state: _tally(tally) for state, tally in result.beyond.items()},
        "injected_flights": result.injected,
        "injected_sdc": result.injected_sdc,
        "injected_alarmed": len(result.delays_s),
        "injected_alarmed_before": result.early_alarms,
        "delays_s": [round(delay, 6) for delay in sorted(result.delays_s)],
    }


def show(console: Console, name: str, result: Evaluation) -> None:
    """Print what there is: of golden flights false alarms and flips found, of injected ones the delay."""
    if result.flights:
        _show_golden(console, name, result)
    if result.injected:
        delays = sorted(result.delays_s)
        middle = f", half of them within {delays[len(delays) // 2]:.2f} s" if delays else ""
        console.print(
            f"{name}: {result.injected} injected flights, {result.injected_sdc} with SDC;"
            f" {len(delays)} alarmed after the fault{middle}, {result.early_alarms} alarms before it"
        )


def _show_golden(console: Console, name: str, result: Evaluation) -> None:
    counts, beyond = result.confusion(), _beyond(result)
    head = Table(title=f"{name}: {result.flights} golden flights", show_header=False)
    for label, value in (
        ("checks", str(result.checks)),
        ("false alarms", f"{result.alarms} in {result.flights_alarmed} flights"),
        ("false alarms a flight", f"{result.alarms_per_flight:.3f}"),
        ("false alarms an hour", f"{result.alarms_per_hour:.2f}"),
        (
            "beyond the largest golden change",
            f"{beyond.found} of {beyond.flips} found ({_percent(beyond)} %)",
        ),
        ("sign and exponent flips", f"{counts['true_positive']} found, {counts['false_negative']} missed"),
        ("area under the ROC", f"{result.area():.4f}"),
    ):
        head.add_row(label, value)
    console.print(head)
    table = Table(title="flips found")
    for column in ("state", "sign %", "exponent %", "mantissa %", "count %", "beyond %", "missed by, p95"):
        table.add_column(column, justify="left" if column == "state" else "right")
    for state in dict.fromkeys(state for state, _ in result.fields):
        tallies = {field: tally for (of, field), tally in result.fields.items() if of == state}
        figures = [_percent(tallies.get(field)) for field in ("sign", "exponent", "mantissa", "count")]
        missed = max(tallies[field].missed(0.95) for field in tallies if field != "mantissa")
        table.add_row(state, *figures, _percent(result.beyond.get(state)), f"{missed:.3g}")
    console.print(table)


def _beyond(result: Evaluation) -> Tally:
    """Over the states that must hold."""
    tallies = [result.beyond[state] for state in MUST_HOLD if state in result.beyond]
    return Tally(sum(tally.flips for tally in tallies), sum(tally.found for tally in tallies))


def _tally(tally: Tally) -> dict[str, Any]:
    return {"flips": tally.flips, "found": tally.found, "rate": _figure(tally.rate)}


def _percent(tally: Tally | None) -> str:
    return "" if tally is None or not tally.flips else f"{100 * tally.rate:.1f}"


def _figure(value: float) -> float | None:
    """Rounded; None where there is nothing to tell of."""
    return round(value, 6) if value == value else None  # noqa: PLR0124 - NaN
