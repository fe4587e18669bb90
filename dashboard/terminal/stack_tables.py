"""What ``zenfi ps`` prints for people."""

from __future__ import annotations

from datetime import UTC, datetime

from rich.table import Table

from deploy.compose.control import ProcessView, StackView


def stack(view: StackView, *, with_host: bool = False) -> Table:
    """A line a process; what went wrong is said in the last column or below."""
    title = f"{view.name} on {view.host}" if with_host else None
    table = Table(title=title, caption=_caption(view) or None, box=None, padding=(0, 2, 0, 0))
    for column in ("process", "state", "for", "pid", "starts", "cpu", "memory", ""):
        table.add_column(
            column, justify="right" if column in ("for", "pid", "starts", "cpu", "memory") else "left"
        )
    for one in view.processes:
        runs = one.pid is not None
        table.add_row(
            one.name,
            one.phase.replace("_", " "),
            _duration((datetime.now(UTC) - one.since).total_seconds()),
            str(one.pid) if runs else "-",
            str(one.life),
            f"{one.cpu_percent:.0f} %" if runs else "-",
            _memory(one) if runs else "-",
            _remarks(one),
        )
    return table


def _remarks(one: ProcessView) -> str:
    said = [one.reason] if one.reason else []
    if one.phase in ("starting", "ready") and one.life > 1 and one.status is not None:
        said.append(f"restarts: {one.restarts}")
    if one.processes > 1:
        said.append(f"{one.processes} processes")
    if one.failed_probes:
        said.append(f"{one.failed_probes} probes failed")
    if one.lost_lines:
        said.append(f"{one.lost_lines} log lines lost")
    if one.cleared:
        said.append(f"{one.cleared} left behind, killed")
    if one.unkilled:
        said.append(f"{one.unkilled} of other users not killed")
    return ", ".join(said)


def _memory(one: ProcessView) -> str:
    limit = f" of {one.memory_limit_bytes / 1e6:.0f}" if one.memory_limit_bytes else ""
    return f"{one.memory_bytes / 1e6:.0f}{limit} MB"


def _caption(view: StackView) -> str:
    said = ["going down"] if view.leaving else []
    if view.cleared:
        said.append(f"{view.cleared} processes of an earlier supervisor were killed at the start")
    if view.unkilled:
        said.append(f"{view.unkilled} of other users were not")
    if view.strays:
        said.append(f"{view.strays} processes whose reaper was killed were killed as well")
    return "; ".join(said)


def _duration(seconds: float) -> str:
    for size, unit in ((86_400, "d"), (3_600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
