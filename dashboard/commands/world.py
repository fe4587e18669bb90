"""``zenfi world``: look at worlds, write them to files."""

from __future__ import annotations

import json
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from dashboard.analysis import plan
from dashboard.terminal.options import as_json
from deploy.config.definitions import inlined
from deploy.errors import BadSpecError
from services.models.mission import MissionSpec
from sim.mission.coverage import WorldFigures, survey
from sim.world import BadWorldError, World, definition, make_world, to_toml, world_names

seed = click.option("--seed", type=int, default=0, show_default=True, help="Seed of what is drawn.")
name = click.argument("name", metavar="NAME|FILE.toml")


@click.group()
def world() -> None:
    """Worlds: what there is, what they look like, as files."""


@world.command("list")
@as_json
def list_worlds(as_json: bool) -> None:
    """List the worlds that are installed with zenfi."""
    for one in world_names():
        kind = definition(one).kind
        click.echo(json.dumps({"name": one, "kind": kind}) if as_json else f"{one:14} {kind}")


@world.command()
@name
@seed
@click.option("--output", type=Path, metavar="FILE.svg|FILE.png", help="Draw a plan view into this file.")
@as_json
def show(name: str, seed: int, output: Path | None, as_json: bool) -> None:
    """Density, free space and clearances of a world; a plan view on demand."""
    made = _world(name, seed)
    if output is not None:
        _draw(made, output)
    figures = survey(made)
    if as_json:
        click.echo(json.dumps({"name": made.name, "seed": made.seed, **figures._asdict()}))
    else:
        Console().print(_table(made, figures))


@world.command()
@name
@seed
@click.argument("file", type=Path)
def export(name: str, seed: int, file: Path) -> None:
    """Write a world, as drawn from its seed, into FILE; ``--world FILE`` flies in it."""
    if file.suffix != ".toml":
        message = f"{file}: a world's file ends in .toml"
        raise BadSpecError(message)
    _write(file, to_toml(_world(name, seed)).encode())


def _world(name: str, seed: int) -> World:
    spec = MissionSpec.model_validate(inlined({"world": name, "seed": seed}))
    try:
        return make_world(spec.world, spec.seed)
    except BadWorldError as error:
        raise BadSpecError(str(error)) from error


def _draw(made: World, output: Path) -> None:
    if output.suffix == ".svg":
        _write(output, plan.svg(made).encode())
    elif output.suffix == ".png":
        _write(output, plan.png(made))
    else:
        message = f"--output {output}: a plan is .svg or .png"
        raise BadSpecError(message)


def _write(path: Path, content: bytes) -> None:
    try:
        path.write_bytes(content)
    except OSError as error:
        message = f"{path}: {error.strerror}"
        raise BadSpecError(message) from error


def _table(made: World, figures: WorldFigures) -> Table:
    table = Table(title=f"{made.name}, seed {made.seed}", show_header=False)
    for label, value in (
        ("obstacles", str(figures.obstacles)),
        ("density (10 m cells held)", f"{100 * figures.density:.0f} %"),
        ("free space", f"{100 * figures.free_space:.1f} %"),
        ("room for the safety body", f"{100 * figures.room_to_fly:.1f} %"),
        ("clearance at the start", f"{figures.start_clearance_m:.2f} m"),
        ("clearance at the goal", f"{figures.goal_clearance_m:.2f} m"),
        ("least clearance on the widest way", f"{figures.widest_way_m:.2f} m"),
    ):
        table.add_row(label, value)
    return table
