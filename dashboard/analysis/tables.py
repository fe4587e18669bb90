"""What the command prints for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from dashboard.campaigns.flight_record import Result
from dashboard.campaigns.results.detection_effects import EFFECTS, Effect, effect
from services.models.detection import DetectionReport
from services.models.outcome import InjectionRecord, NodeReport, Outcome, RecordingReport
from services.models.propagation import Propagation

if TYPE_CHECKING:  # they load SQLAlchemy, which a flight does without
    from dashboard.campaigns.forecast import Forecast
    from dashboard.campaigns.presets import CampaignPreset
    from dashboard.campaigns.results.compare import Comparison
    from dashboard.campaigns.results.summary import CellSummary
    from dashboard.campaigns.statistics.proportions import Interval
    from injector.capabilities import Capability

NODE_RESULTS = ("benign", "sdc", "crash", "hang")
ALARMS_SHOWN = 8


def outcome(one: Outcome) -> Table:
    """One flight as a table of names and values, its golden twin beside it."""
    table = Table(
        title=f"{one.spec.world_name}, seed {one.spec.seed}: {one.result}", show_header=one.golden is not None
    )
    table.add_column("")
    table.add_column("this flight", justify="right")
    if one.golden is not None:
        table.add_column("golden twin", justify="right")
    golden = one.golden.qof if one.golden is not None else None
    for label, unit, field in (
        ("flight time", "s", "flight_time_s"),
        ("distance", "m", "distance_m"),
        ("energy", "kJ", "energy_kj"),
        ("missions per charge", "", "missions_per_charge"),
        ("replans", "", "replans"),
        ("smallest clearance", "m", "min_clearance_m"),
    ):
        cells = [_number(getattr(qof, field), unit) for qof in (one.qof, golden) if qof is not None]
        table.add_row(label, *cells)
    if one.qof.coverage is not None:
        table.add_row("coverage", f"{one.qof.coverage:.0%}")
    _add_verdicts(table, one)
    table.add_row("wall time", f"{one.wall_s:.2f} s" if one.proof is None else f"proven: {one.proof.told}")
    for stage, report in one.nodes.items():
        told = [*report.causes, *_counted(report)]
        table.add_row(stage, report.result + (f" ({', '.join(told)})" if told else ""))
    if one.detection is not None:
        table.add_row("detection", _detection(one.detection, effect(Result.of(one))))
    if one.refused_messages:
        table.add_row("messages not recorded", str(one.refused_messages))
    if one.injection is not None:
        table.add_row("injection", _injection(one.injection))
    if one.recording is not None:
        table.add_row("recording", _recording(one.recording))
    if one.propagation is not None:
        table.add_row("strayed", _strayed(one.propagation))
    return table


def _add_verdicts(table: Table, flight: Outcome) -> None:
    """Add what is said of a flight's properties, and of harm."""
    for one in flight.properties:
        verdict = "holds" if one.holds else f"violated at {one.at_ns / 1e9:.2f} s"
        table.add_row(one.property, f"{verdict}, margin {one.robustness:+.3g}")
    if flight.harm is not None:
        told = (f"{event.kind.replace('_', ' ')} at {event.at_ns / 1e9:.2f} s" for event in flight.harm)
        table.add_row("harm", "\n".join(told) or "none")


def propagation(found: Propagation) -> Table:
    """The topics that left the golden twin's, in the order in which they did."""
    injected = "nothing was injected"
    if found.struck_at_ns is not None:
        injected = f"{found.struck_stage} was injected at {found.struck_at_ns / 1e9:.3f} s"
    reached = "the command is the twin's"
    if found.command_at_ns is not None:
        reached = f"it reached the command at {found.command_at_ns / 1e9:.3f} s"
    table = Table(
        title=f"{injected}; {reached}", caption=f"as the twin's: {', '.join(found.same) or 'nothing'}"
    )
    for heading in ("topic", "from s", "tick", "through", "first", "largest", "at s", "last"):
        table.add_column(heading, justify="left" if heading in ("topic", "through") else "right")
    for one in found.topics:
        numbers = (one.first, one.largest, one.last)
        first, largest, last = ("" if number is None else f"{number:.3g} {one.unit}" for number in numbers)
        at_s = "" if one.largest_at_ns is None else f"{one.largest_at_ns / 1e9:.3f}"
        through = ", ".join(one.causes)
        table.add_row(one.topic, f"{one.at_ns / 1e9:.3f}", str(one.tick), through, first, largest, at_s, last)
    return table


def _recording(report: RecordingReport) -> str:
    lost = f", {report.dropped} dropped" if report.dropped else ""
    return f"{report.messages} messages{lost}, {report.size_bytes / 1e6:.1f} MB"


def _strayed(found: Propagation) -> str:
    return "\n".join(f"{one.topic} from {one.at_ns / 1e9:.3f} s" for one in found.topics) or "nothing"


def _counted(report: NodeReport) -> list[str]:
    counts = {
        "malformed": report.malformed,
        "outdated": report.outdated,
        "alarms": report.alarms,
        "recomputed": report.recomputed,
        "ungated": report.ungated,
        "lost": report.lost,
    }
    return [f"{count} {name}" for name, count in counts.items() if count]


def _detection(report: DetectionReport, made: Effect | None) -> str:
    true = sum(alarm.true for alarm in report.alarms)
    lines = [f"the fault was {made}"] if made is not None else []
    lines += [
        f"alarms: {true} true, {len(report.alarms) - true} false; {report.checks} checks",
        f"{report.detection_share:.4%} of the time, recomputation {report.recomputation_share:.2%}",
    ]
    lines += [
        f"{one.virtual_time_ns / 1e9:.2f} s: {one.stage}, {one.state or 'nonsense'}: "
        f"{one.action.replace('_', ' ')}"
        for one in report.alarms[:ALARMS_SHOWN]
    ]
    if len(report.alarms) > ALARMS_SHOWN:
        lines.append(f"and {len(report.alarms) - ALARMS_SHOWN} more")
    return "\n".join(lines)


def _injection(record: InjectionRecord) -> str:
    if record.status != "injected":
        return f"{record.status}: {record.reason}"
    where = f"{record.operand} {record.register_name or hex(record.address)}".strip()
    change = f"bit {', '.join(map(str, record.bits))}: {record.before} -> {record.after}"
    lines = [f"{record.kernel}: {record.instruction}", f"{record.model}: {where} {change}"]
    if record.instruction_after:
        lines.append(f"executed: {record.instruction_after}")
    if record.held_instructions:
        lines.append(f"held for {record.held_instructions} instructions")
    if record.strikes:
        lines.append(f"struck {record.strikes} times, first at {record.virtual_time_ns / 1e9:.3f} s")
    return "\n".join([*lines, record.reason] if record.reason else lines)


def _number(value: float, unit: str) -> str:
    text = str(value) if isinstance(value, int) else f"{value:.1f}"
    return f"{text} {unit}".strip()


def campaign(name: str, summary: Sequence[CellSummary]) -> Table:
    """Quality of flight per cell; fits a terminal of 80 columns."""
    failed = sum(line.failed_to_fly for line in summary)
    lost = f" {failed} runs failed to fly and count nowhere: see zenfi campaign export." if failed else ""
    if proven := sum(line.proven for line in summary):
        flown = sum(line.runs - line.failed_to_fly for line in summary) - proven
        lost = f" {flown:,} were flown, {proven:,} proven the same." + lost
    table = Table(
        title=f"{name}: quality of flight per arm",
        caption="95 %: Wilson interval of success. s, m, kJ: medians of successes; plans: mean of replans. "
        "hit: the fault struck; harm: of these, harmed; then what became of the node aimed at." + lost,
        box=None,
        padding=(0, 1, 0, 0),
    )
    table.add_column("arm")
    for column in ("success", "95 %", "s", "m", "kJ", "plans", "hit", "harm", *NODE_RESULTS):
        table.add_column(column, justify="right")
    many_worlds = len({line.world for line in summary}) > 1
    for line in summary:
        table.add_row(
            cell_name(line, many_worlds),
            f"{line.successes}/{line.runs - line.failed_to_fly}",
            f"{100 * line.success_low:.0f}-{100 * line.success_high:.0f}",
            *(_cell(value) for value in (line.flight_time_s, line.distance_m, line.energy_kj, line.replans)),
            str(line.injected) if line.aimed else "-",
            "-" if line.harmed is None else str(line.harmed),
            *(str(line.results.get(result, 0)) if line.aimed else "-" for result in NODE_RESULTS),
        )
    return table


def effects(summary: Sequence[CellSummary]) -> Table | None:
    """What detectors made of the faults, per cell; None if no fault met one. Fits 80 columns."""
    watched = [line for line in summary if line.effects]
    if not watched:
        return None
    table = Table(
        title="what detectors made of the faults",
        caption="unaffected: every message as the golden twin's. missed: messages differ, no alarm. "
        "caught: an alarm. recovered: caught, something was done, nearer the twin than without a detector.",
        box=None,
        padding=(0, 1, 0, 0),
    )
    table.add_column("arm")
    for word in EFFECTS:
        table.add_column(word, justify="right")
    many_worlds = len({line.world for line in summary}) > 1
    for line in watched:
        table.add_row(cell_name(line, many_worlds), *(str(line.effects.get(word, 0)) for word in EFFECTS))
    return table


def cell_name(line: CellSummary, many_worlds: bool) -> str:
    """What a line of a campaign's table is called."""
    parts = (line.arm, line.world if many_worlds else "", line.fault)
    return " ".join(part for part in parts if part)


def campaigns(lines: Sequence[Mapping[str, object]]) -> Table:
    """A table of the campaigns in a store."""
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("campaign", "phase", "done", "of", "failed", "created", "reason"):
        table.add_column(column, justify="right" if column in ("done", "of", "failed") else "left")
    for line in lines:
        names = ("campaign", "phase", "done", "runs", "failed", "created", "reason")
        table.add_row(*(str(line[name]) for name in names))
    return table


def files(counts: Mapping[str, Mapping[str, int]]) -> str:
    """What became of the files of runs, and how large they are."""
    told = (f"{one['runs']} {fate} ({one['bytes'] / 1e6:.1f} MB)" for fate, one in sorted(counts.items()))
    return f"files of runs: {', '.join(told)}"


def replays(counts: Mapping[str, int]) -> str:
    """How many injected flights were flown again, and how many were the same."""
    told = f"{sum(counts.values())} flown again, {counts.get('replayed', 0)} replayed"
    others = (f"{count} {answer.replace('_', ' ')}" for answer, count in sorted(counts.items()))
    return ", ".join([told, *(one for one in others if not one.endswith(" replayed"))])


def presets(plans: Sequence[tuple[CampaignPreset, Forecast]]) -> Table:
    """The campaigns that come along; fits a terminal of 80 columns."""
    table = Table(box=None, padding=(0, 1, 0, 0))
    for column in ("preset", "cells", "flights", "time", ""):
        table.add_column(column, justify="right" if column in ("cells", "flights", "time") else "left")
    for preset, plan in plans:
        flights = str(plan.runs + plan.twins)
        table.add_row(preset.name, str(plan.cells), flights, _time(plan), preset.about)
    return table


def _time(plan: Forecast) -> str:
    minutes = plan.hours * 60
    return f"{minutes / 60:.1f} h" if minutes >= 90 else f"{max(minutes, 1):.0f} min"


def forecast(label: str, plan: Forecast) -> str:
    """One paragraph: what a campaign takes and can tell."""
    source = "as flights took here" if plan.measured else "a guess: nothing was flown here yet"
    drop = plan.resolvable_drop
    tells = (
        f"a drop of success from 95 % by {100 * drop:.0f} points"
        if drop is not None
        else "no drop of success from 95 %"
    )
    return (
        f"{label}: {plan.runs} flights in {plan.cells} cells and {plan.twins} golden twins, about "
        f"{_time(plan)} ({source}), {plan.disk_mb:.1f} MB. {plan.per_cell} flights a cell can tell {tells} "
        "(two cells, 80 % power)."
    )


def comparison(label: str, compared: Sequence[Comparison]) -> Table:
    """Cells beside their reference; fits a terminal of 80 columns."""
    table = Table(
        title=f"{label}: beside {compared[0].reference}",
        caption="success: of the cell, of its reference; change in points, Newcombe's paired 95 % interval; "
        "p: exact McNemar, Holm-adjusted. s, kJ: median of the paired difference where both arrived "
        "(both), bootstrap 95 %; p95: its 95th percentile.",
        box=None,
        padding=(0, 1, 0, 0),
    )
    table.add_column("cell")
    for column in ("n", "success", "change", "p", "both", "s", "s p95", "kJ"):
        table.add_column(column, justify="right")
    for one in compared:
        change = f"{100 * (one.success_difference or 0.0):+.0f}\n{_range(one.success_interval, 100)}"
        table.add_row(
            one.cell,
            str(one.pairs),
            f"{one.successes}\n{one.reference_successes}",
            change,
            f"{one.p_adjusted:.2g}",
            str(one.flight_time_s.pairs),
            _quantile(one.flight_time_s.median, one.flight_time_s.median_interval),
            _quantile(one.flight_time_s.p95, one.flight_time_s.p95_interval),
            _quantile(one.energy_kj.median, one.energy_kj.median_interval),
        )
    return table


def _quantile(value: float | None, interval: Interval | None) -> str:
    if value is None:
        return "-"
    return f"{value:+.1f}\n{_range(interval, 1) if interval is not None else '-'}"


def _range(interval: Interval, scale: float) -> str:
    digits = 0 if scale > 1 else 1
    return f"{scale * interval.low:+.{digits}f}..{scale * interval.high:+.{digits}f}"


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def findings(checks: Sequence[Capability]) -> Table:
    """A table of what ``zenfi doctor`` has found."""
    table = Table()
    for column in ("check", "", "remedy"):
        table.add_column(column)
    for finding in checks:
        verdict = "[green]ok[/green]" if finding.ok else "[red]no[/red]"
        table.add_row(finding.name, verdict, "" if finding.ok else finding.remedy)
    return table
