"""``zenfi fly``, ``doctor`` and ``plugins``: fly one mission, and what this installation has for it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from dashboard.analysis import tables
from dashboard.analysis.why import why
from dashboard.commands.ros2 import RosOptions, in_domain, shown_in_ros
from dashboard.terminal.options import as_json
from deploy.config.written_faults import DETECTOR_FORM, FAULT_FORM, parse_fault
from deploy.doctor import examine
from services.system import plug_ins
from zenfi.missions import fly_mission, mission_of

LINK_FORM = "MS[,LOSS]"


@click.command()
@click.option("--mission", default="navigation", show_default=True, help="What to do; see docs/missions.md.")
@click.option("--world", default="sparse", show_default=True, metavar="NAME|FILE.toml", help="Where to fly.")
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of everything random.")
@click.option("--airframe", default="airsim", show_default=True, metavar="NAME|FILE.toml", help="What flies.")
@click.option(
    "--planner", default="rrt_star", show_default=True, help="rrt, rrt_connect, rrt_star or prm_star."
)
@click.option(
    "--platform",
    default="i9-9940x",
    show_default=True,
    metavar="NAME|FILE.toml",
    help="Computer whose latencies apply.",
)
@click.option("--clock", default="lockstep", show_default=True, help="lockstep or realtime.")
@click.option("--profile", default="fast", show_default=True, help="Set of parameters: fast or paper.")
@click.option("--stack", metavar="FILE.toml", help="Programs of your own in the place of stages.")
@click.option("--pilot", default="guarded", show_default=True, help="guarded (ours) or baseline (published).")
@click.option(
    "--guards",
    metavar="NAME,..",
    help="Only these guards of docs/pilots.md, or none; default: the pilot's.",
)
@click.option("--energy", default="airframe", show_default=True, help="airframe, regression or momentum.")
@click.option(
    "--link",
    metavar=LINK_FORM,
    help="Delay, each way, and loss between the companion computer and what it flies, e.g. 20,0.01.",
)
@click.option("--detector", metavar=DETECTOR_FORM, help="Watch the flight, e.g. gaussian,recovery=control.")
@click.option(
    "--fault",
    metavar=FAULT_FORM,
    help="Flip a bit, e.g. instruction:rrt_star,operand=source or source:trajectory.x; "
    "model=none does everything but the flip. Or let equipment fail, e.g. sensor:depth,model=off.",
)
@click.option("--fault-seed", type=int, default=0, show_default=True, help="Seed of the fault.")
@click.option(
    "--fault-over",
    type=click.Choice(["calls", "time"]),
    default="calls",
    show_default=True,
    help="Draw the injected call over the kernel's calls or over the flight's time.",
)
@click.option(
    "--property",
    "properties",
    multiple=True,
    metavar="TEXT",
    help="Judge the flight, e.g. 'always clearance >= 0.3'; may be repeated (docs/properties.md).",
)
@click.option(
    "--time-factor",
    type=float,
    help="Flight time beyond so many times the golden twin's is harm; default: 1.5.",
)
@click.option(
    "--record", type=click.Path(path_type=Path, dir_okay=False), help="Record the messages: FILE.mcap."
)
@click.option(
    "--companion",
    metavar="HOST",
    help="Have the stages run on that host's companion computer (zenfi companion).",
)
@shown_in_ros
@as_json
def fly(
    detector: str | None,
    fault: str | None,
    fault_seed: int,
    fault_over: str,
    record: Path | None,
    companion: str | None,
    ros: RosOptions | None,
    as_json: bool,
    guards: str | None,
    link: str | None,
    time_factor: float | None,
    **fields: Any,
) -> None:
    """Fly one mission; with --fault, its golden twin first."""
    if guards is not None:
        fields["guards"] = [] if guards == "none" else guards.split(",")
    if link is not None:
        fields["link"] = _link(link)
    if time_factor is not None:
        fields["harm"] = {"time_factor": time_factor}
    aimed = parse_fault(fault, fault_seed, fault_over) if fault is not None else None
    spec = mission_of(fault=aimed, detector=detector, **fields)
    with in_domain(ros, spec) as watch:
        outcome = fly_mission(spec, record, watch, companion)
    if as_json:
        click.echo(outcome.model_dump_json(by_alias=True))
    else:
        Console().print(tables.outcome(outcome))
        if outcome.injection is not None:
            click.echo(why(outcome))


def _link(text: str) -> dict[str, float]:
    """The fields of a link that was written as :data:`LINK_FORM` says."""
    delay, _, loss = text.partition(",")
    try:
        return {"delay_ms": float(delay), "loss": float(loss or 0)}
    except ValueError:
        raise click.BadParameter(f"{text!r}; {LINK_FORM}, e.g. 20 or 20,0.01", param_hint="--link") from None


@click.command()
@as_json
def doctor(as_json: bool) -> None:
    """Check what this machine allows (tracing, timers, sockets, processors), and fly once."""
    findings = examine()
    if as_json:
        for finding in findings:
            click.echo(json.dumps({"check": finding.name, "ok": finding.ok, "remedy": finding.remedy}))
    else:
        Console().print(tables.findings(findings))
    if not all(finding.ok for finding in findings):
        sys.exit(1)


@click.command()
@as_json
def plugins(as_json: bool) -> None:
    """List planners, guards, worlds, pilots, masks, signals and detectors that are installed by entry point.

    Each is imported to see whether it works; exit status 1 if one does not.
    """
    found = plug_ins.listing()
    if as_json:
        for one in found:
            click.echo(json.dumps(one._asdict()))
    else:
        table = Table("kind", "name", "package", "where", "state", box=None)
        for one in found:
            table.add_row(
                one.kind,
                one.name,
                f"{one.package} {one.version}",
                one.value,
                "not usable" if one.problem else "works",
            )
        Console().print(table)
        for one in found:
            if one.problem:
                click.echo(f"zenfi: {one.problem}", err=True)
    if any(one.problem for one in found):
        raise SystemExit(1)
