"""The ``zenfi`` command: its groups and the flight of single missions.

With ``--json``, standard output carries one JSON object per line and nothing else; messages go to
standard error. Exit status: 0 done, 1 we failed, 2 bad input (one clear line), 130 interrupted.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
from pydantic import ValidationError
from rich.console import Console

from dashboard.analysis import tables
from dashboard.campaigns.spec import load_campaign
from dashboard.campaigns.store.database import StoreError
from dashboard.commands.announce import announce
from dashboard.commands.bench import bench
from dashboard.commands.campaign import as_picture, campaign
from dashboard.commands.harm import harm
from dashboard.commands.inject import inject
from dashboard.commands.kernels import kernels
from dashboard.commands.recordings import propagation, view
from dashboard.commands.redundancy import redundancy
from dashboard.commands.replay import replay
from dashboard.commands.ros2 import RosOptions, in_domain, ros2, shown_in_ros
from dashboard.commands.service import foxglove, serve, token
from dashboard.commands.stack import down, logs, ps, restart, stop, up
from dashboard.commands.train import train
from dashboard.commands.world import world
from dashboard.terminal.campaign_progress import run_new
from dashboard.terminal.options import (
    DETECTOR_FORM,
    FAULT_FORM,
    as_json,
    detector_fields,
    in_store,
    parse_fault,
)
from deploy.compose.folder import StackError
from deploy.config.check import BadSpecError, check, one_line
from deploy.config.definitions import inlined
from deploy.doctor import examine
from deploy.errors import InfrastructureError
from deploy.mission.fork_server import ForkServer, ForkServerError
from deploy.mission.golden_twin import NothingToInjectError, PairFlyer
from detector.errors import DetectionInputError
from services.models.mission import MissionSpec


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
@click.option("--stack", metavar="FILE.toml", help="Programs of your own in the place of stages.")
@click.option("--pilot", default="guarded", show_default=True, help="guarded (ours) or baseline (published).")
@click.option(
    "--guards",
    metavar="NAME,..",
    help="Only these guards of docs/pilots.md, or none; default: the pilot's.",
)
@click.option("--energy", default="airframe", show_default=True, help="airframe, regression or momentum.")
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
@shown_in_ros
@as_json
def fly(
    detector: str | None,
    fault: str | None,
    fault_seed: int,
    fault_over: str,
    record: Path | None,
    ros: RosOptions | None,
    as_json: bool,
    guards: str | None,
    time_factor: float | None,
    **fields: Any,
) -> None:
    """Fly one mission; with --fault, its golden twin first."""
    if guards is not None:
        fields["guards"] = [] if guards == "none" else guards.split(",")
    if time_factor is not None:
        fields["harm"] = {"time_factor": time_factor}
    if detector is not None:
        fields["detector"] = detector_fields(detector)
    if fault is not None:
        fields["fault"] = parse_fault(fault, fault_seed, fault_over)
    spec = MissionSpec.model_validate(inlined(fields))
    check(spec)
    if record is not None and not record.parent.is_dir():
        message = f"--record {record}: there is no folder {record.parent}"
        raise BadSpecError(message)
    with in_domain(ros, spec) as watch:
        server = ForkServer()
        try:
            outcome = PairFlyer(server, watch).fly(spec, record)
        finally:
            server.close()
    if outcome.recording is not None and outcome.recording.problem:
        message = f"recording {record}: {outcome.recording.problem}"
        raise InfrastructureError(message)
    if as_json:
        click.echo(outcome.model_dump_json(by_alias=True))
    else:
        Console().print(tables.outcome(outcome))


zenfi.add_command(world)
zenfi.add_command(announce)
zenfi.add_command(bench)
zenfi.add_command(harm)
zenfi.add_command(inject)
zenfi.add_command(kernels)
zenfi.add_command(replay)
zenfi.add_command(redundancy)
zenfi.add_command(view)
zenfi.add_command(propagation)
zenfi.add_command(ros2)
zenfi.add_command(train)


zenfi.add_command(campaign)
zenfi.add_command(serve)
zenfi.add_command(token)
zenfi.add_command(foxglove)
for command in (up, ps, logs, restart, stop, down):
    zenfi.add_command(command)


@zenfi.command()
@in_store
@as_json
@as_picture
def demo(store: str, as_json: bool, svg: Path | None) -> None:
    """A small campaign in Sparse: golden flights beside flights with one flipped bit."""
    run_new(load_campaign("demo"), None, store, as_json, svg)


@zenfi.command()
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the ``zenfi`` command, with what was typed or with ``arguments``."""
    try:
        zenfi.main(arguments, standalone_mode=False)
    except (
        click.ClickException,
        BadSpecError,
        NothingToInjectError,
        DetectionInputError,
        StackError,
    ) as error:
        text = error.format_message() if isinstance(error, click.ClickException) else str(error)
        _give_up(text, 2)
    except ValidationError as error:
        _give_up(one_line(error), 2)
    except (InfrastructureError, ForkServerError, StoreError) as error:
        _give_up(str(error), 1)
    except (KeyboardInterrupt, click.Abort):
        _give_up("interrupted", 130)


def _give_up(text: str, status: int) -> None:
    click.echo(f"zenfi: {text}", err=True)
    sys.exit(status)
