"""``zenfi redundancy``: what DMR and TMR cost a vehicle by weight alone."""

from __future__ import annotations

from typing import Any

import click
from rich.console import Console
from rich.table import Table

from dashboard.terminal.options import as_json
from deploy.config.definitions import inlined
from deploy.errors import BadSpecError
from sim.vehicle.airframe import BadAirframeError
from sim.vehicle.redundancy import RedundancyStudy, study


def _default(field: str) -> Any:
    return RedundancyStudy.model_fields[field].default


@click.command()
@click.option(
    "--airframe",
    default=_default("airframe"),
    show_default=True,
    metavar="NAME|FILE.toml",
    help="What flies.",
)
@click.option("--response-s", type=float, default=_default("response_s"), show_default=True)
@click.option("--range-m", type=float, default=_default("range_m"), show_default=True)
@click.option("--computer-kg", type=float, default=_default("computer_kg"), show_default=True)
@as_json
def redundancy(as_json: bool, **fields: Any) -> None:
    """Safe velocity and flight time with one, two and three computers (F-1 model)."""
    try:
        results = study(RedundancyStudy.model_validate(inlined(fields)))
    except BadAirframeError as error:
        raise BadSpecError(str(error)) from error
    if as_json:
        for one in results:
            click.echo(one.model_dump_json())
        return
    table = Table()
    for column in ("scheme", "mass kg", "thrust / weight", "acceleration m/s^2", "safe velocity m/s", "time"):
        table.add_column(column, justify="left" if column == "scheme" else "right")
    for one in results:
        figures = (one.mass_kg, one.thrust_to_weight, one.acceleration_m_s2, one.safe_velocity_m_s)
        factor = "cannot fly" if one.time_factor is None else f"x {one.time_factor:.2f}"
        table.add_row(one.scheme, *(f"{figure:.2f}" for figure in figures), factor)
    Console().print(table)
