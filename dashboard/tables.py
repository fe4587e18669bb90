"""What the command prints for people."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from dashboard.campaigns.summary import ArmSummary
from injector.preflight import Finding
from services.bus.outcome import InjectionRecord, NodeReport, Outcome

NODE_RESULTS = ("benign", "sdc", "crash", "hang")


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
    table.add_row("wall time", f"{one.wall_s:.2f} s")
    for stage, report in one.nodes.items():
        told = [*report.causes, *_counted(report)]
        table.add_row(stage, report.result + (f" ({', '.join(told)})" if told else ""))
    if one.refused_messages:
        table.add_row("messages not recorded", str(one.refused_messages))
    if one.injection is not None:
        table.add_row("injection", _injection(one.injection))
    return table


def _counted(report: NodeReport) -> list[str]:
    counts = {
        "malformed": report.malformed,
        "outdated": report.outdated,
        "alarms": report.alarms,
        "recomputed": report.recomputed,
    }
    return [f"{count} {name}" for name, count in counts.items() if count]


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
    return "\n".join([*lines, record.reason] if record.reason else lines)


def _number(value: float, unit: str) -> str:
    text = str(value) if isinstance(value, int) else f"{value:.1f}"
    return f"{text} {unit}".strip()


def campaign(name: str, summary: Sequence[ArmSummary]) -> Table:
    """Quality of flight per arm; fits a terminal of 80 columns."""
    table = Table(
        title=f"{name}: quality of flight per arm",
        caption="95 %: Wilson interval of success. s, m, kJ: medians of successes; plans: mean of replans. "
        "hit: flights in which the bit was flipped; then what became of the node aimed at.",
        box=None,
        padding=(0, 1, 0, 0),
    )
    table.add_column("arm")
    for column in ("success", "95 %", "s", "m", "kJ", "plans", "hit", *NODE_RESULTS):
        table.add_column(column, justify="right")
    for line in summary:
        aimed = bool(line.results)
        table.add_row(
            line.arm,
            f"{line.successes}/{line.runs - line.failed_to_fly}",
            f"{100 * line.success_low:.0f}-{100 * line.success_high:.0f}",
            *(_cell(value) for value in (line.flight_time_s, line.distance_m, line.energy_kj, line.replans)),
            str(line.injected) if aimed else "-",
            *(str(line.results.get(result, 0)) if aimed else "-" for result in NODE_RESULTS),
        )
    return table


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def findings(checks: Sequence[Finding]) -> Table:
    """What the doctor found."""
    table = Table()
    for column in ("check", "", "remedy"):
        table.add_column(column)
    for finding in checks:
        verdict = "[green]ok[/green]" if finding.ok else "[red]no[/red]"
        table.add_row(finding.name, verdict, "" if finding.ok else finding.remedy)
    return table
