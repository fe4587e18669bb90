"""``zenfi study map``: which bits of which place harm, and in which phase of the flight."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import click

from dashboard.campaigns.statistics.proportions import wilson
from dashboard.campaigns.store.store import Store
from dashboard.studies import sensitivity_page
from dashboard.studies.folder import PAGE
from dashboard.studies.sensitivity import gather
from dashboard.terminal.options import as_json, in_store
from deploy.errors import BadSpecError


@click.command("map")
@click.argument("labels", metavar="LABEL...", nargs=-1, required=True)
@click.option(
    "--output",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("map"),
    show_default=True,
    help="The folder that is written.",
)
@click.option(
    "--phases",
    type=click.IntRange(1, 100),
    default=3,
    show_default=True,
    help="Equal parts of the golden twin's flight.",
)
@in_store
@as_json
def map_(labels: tuple[str, ...], output: Path, phases: int, store: str, as_json: bool) -> None:
    """Map the harm of campaigns LABEL... by place, bits and phase of the flight.

    Of faults that struck once, in flights without a detector; all others are counted. The folder has the
    page, map.csv and map.svg.
    """
    with closing(Store(store)) as opened:
        found = gather(opened, [opened.find(label) for label in labels], phases)
    if not found.fields:
        left = ", ".join(f"{count} {reason}" for reason, count in found.left_out.items())
        message = f"{', '.join(labels)}: no fault struck once ({left or 'golden flights only'})"
        raise BadSpecError(message)
    sensitivity_page.write(output, labels, found)
    if as_json:
        for at, rate in found.fields.items():
            ends = wilson(*rate)
            click.echo(
                json.dumps(
                    at._asdict()
                    | {"struck": rate.of, "harmed": rate.found, "low": ends.low, "high": ends.high}
                )
            )
        return
    harmed = sum(one.found for one in found.fields.values())
    click.echo(f"{output / PAGE}: {found.struck} faults, {harmed} harmed, {len(found.fields)} fields")
