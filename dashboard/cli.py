"""The ``zenfi`` command.

With ``--json``, standard output carries one JSON object per line and nothing else; messages go to
standard error. Exit status: 0 done, 1 we failed, 2 bad input (one clear line), 130 interrupted.
"""

from __future__ import annotations

import json
import sys
from io import StringIO
from pathlib import Path
from typing import Any

import click
from pydantic import ValidationError
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from dashboard import tables
from dashboard.campaigns.local import Finished, fly_all
from dashboard.campaigns.spec import CampaignSpec, load_campaign, runs
from dashboard.campaigns.summary import summarise
from dashboard.commands.bench import bench
from dashboard.commands.fault import FORM, parse_fault
from dashboard.commands.options import as_json
from dashboard.commands.redundancy import redundancy
from dashboard.commands.train import train
from dashboard.commands.world import world
from deploy.check import BadSpecError, check, one_line
from deploy.definitions import inlined
from deploy.doctor import examine
from deploy.forkserver import ForkServer, ForkServerError
from deploy.pairing import NothingToInjectError, Pairs
from deploy.supervisor import InfrastructureError
from detector.errors import DetectionInputError
from services.bus.mission import MissionSpec

messages = Console(stderr=True)

as_picture = click.option(
    "--svg", type=click.Path(dir_okay=False, writable=True, path_type=Path), help="Also draw the table."
)
PICTURE_COLUMNS = 90


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="zenfi")
def zenfi() -> None:
    """Fault injection for autonomous machines: what does one flipped bit do to the mission?"""


@zenfi.command()
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
@click.option("--energy", default="airframe", show_default=True, help="airframe, regression or momentum.")
@click.option("--fault", metavar=FORM, help="Flip one bit, e.g. instruction:rrt_star,operand=source.")
@click.option("--fault-seed", type=int, default=0, show_default=True, help="Seed of the fault.")
@as_json
def fly(fault: str | None, fault_seed: int, as_json: bool, **fields: Any) -> None:
    """Fly one mission; with --fault, its golden twin first."""
    if fault is not None:
        fields["fault"] = parse_fault(fault, fault_seed)
    spec = MissionSpec.model_validate(inlined(fields))
    check(spec)
    server = ForkServer()
    try:
        outcome = Pairs(server).fly(spec)
    finally:
        server.close()
    if as_json:
        click.echo(outcome.model_dump_json(by_alias=True))
    else:
        Console().print(tables.outcome(outcome))


zenfi.add_command(world)
zenfi.add_command(bench)
zenfi.add_command(redundancy)
zenfi.add_command(train)


@zenfi.group()
def campaign() -> None:
    """Many flights, compared."""


@campaign.command("run")
@click.argument("spec")
@click.option("--slots", type=click.IntRange(1, 256), help="Flights at a time (default: one per processor).")
@as_json
@as_picture
def campaign_run(spec: str, slots: int | None, as_json: bool, svg: Path | None) -> None:
    """Fly the campaign in the TOML file SPEC, or the preset of that name."""
    _run(load_campaign(spec), slots, as_json, svg)


@zenfi.command()
@as_json
@as_picture
def demo(as_json: bool, svg: Path | None) -> None:
    """A small campaign in Sparse: golden flights beside flights with one flipped bit."""
    _run(load_campaign("demo"), None, as_json, svg)


def _run(spec: CampaignSpec, slots: int | None, as_json: bool, svg: Path | None) -> None:
    planned = list(runs(spec))
    finished: list[Finished] = []
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=messages) as progress:
        task = progress.add_task(spec.name, total=len(planned))
        for one in fly_all(planned, slots):
            finished.append(one)
            progress.advance(task)
            if one.outcome is None:
                progress.console.print(
                    f"[red]not flown[/red]: {one.run.arm}, run {one.run.index}: {one.error}"
                )
            if as_json:
                _line(one)
    summary = summarise([arm.name for arm in spec.arms], finished)
    if as_json:
        click.echo(json.dumps({"summary": [line.model_dump() for line in summary]}))
    else:
        Console().print(tables.campaign(spec.name, summary))
    if svg is not None:
        paper = Console(record=True, file=StringIO(), width=PICTURE_COLUMNS)
        paper.print(tables.campaign(spec.name, summary))
        paper.save_svg(str(svg), title=f"zenfi campaign run {spec.name}")
    if any(one.outcome is None for one in finished):
        sys.exit(1)


def _line(one: Finished) -> None:
    head: dict[str, Any] = {"arm": one.run.arm, "index": one.run.index}
    if one.outcome is None:
        click.echo(json.dumps({**head, "error": one.error}))
    else:
        click.echo(json.dumps({**head, "outcome": one.outcome.model_dump(mode="json", by_alias=True)}))


@zenfi.command()
@as_json
def doctor(as_json: bool) -> None:
    """Check what this machine allows: tracing, timers, sockets, processors."""
    findings = examine()
    if as_json:
        for finding in findings:
            click.echo(json.dumps({"check": finding.name, "ok": finding.ok, "remedy": finding.remedy}))
    else:
        Console().print(tables.findings(findings))
    if not all(finding.ok for finding in findings):
        sys.exit(1)


def main() -> None:
    """Entry point of the ``zenfi`` command."""
    try:
        zenfi.main(standalone_mode=False)
    except (click.ClickException, BadSpecError, NothingToInjectError, DetectionInputError) as error:
        text = error.format_message() if isinstance(error, click.ClickException) else str(error)
        _give_up(text, 2)
    except ValidationError as error:
        _give_up(one_line(error), 2)
    except (InfrastructureError, ForkServerError) as error:
        _give_up(str(error), 1)
    except (KeyboardInterrupt, click.Abort):
        _give_up("interrupted", 130)


def _give_up(text: str, status: int) -> None:
    click.echo(f"zenfi: {text}", err=True)
    sys.exit(status)
