"""``zenfi study design``: which protection of each kernel leaves how much harm, and at what cost."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import click

from dashboard.campaigns.store.store import Store
from dashboard.design import report
from dashboard.design.check import CheckedDesign, check_designs
from dashboard.design.gather import FLIGHTS, DesignRequest, study_designs
from dashboard.evidence.budget import load_budget
from dashboard.terminal.options import as_json, in_store
from deploy.config.definitions import inlined
from deploy.errors import BadSpecError
from sim.vehicle.airframe import BadAirframeError
from sim.vehicle.redundancy import RedundancyStudy

_folder = click.Path(file_okay=False, path_type=Path)


def _default(field: str) -> Any:
    return RedundancyStudy.model_fields[field].default


@click.command()
@click.argument("labels", metavar="LABEL...", nargs=-1, required=True)
@click.option(
    "--budget",
    type=click.Path(dir_okay=False, path_type=Path),
    help="TOML: how often each element is upset, and the cell that flew it bare.",
)
@click.option(
    "--output", type=_folder, default=Path("design"), show_default=True, help="The folder that is written."
)
@click.option(
    "--flights",
    type=click.IntRange(1, 100_000),
    default=FLIGHTS,
    show_default=True,
    help="Of each element and world, in the campaign that flies a design.",
)
@click.option("--response-s", type=float, default=_default("response_s"), show_default=True)
@click.option("--range-m", type=float, default=_default("range_m"), show_default=True)
@click.option("--computer-kg", type=float, default=_default("computer_kg"), show_default=True)
@click.option("--check", type=_folder, help="Hold LABEL..., which fly designs of that folder, against it.")
@in_store
@as_json
def design(
    labels: tuple[str, ...],
    budget: Path | None,
    output: Path,
    flights: int,
    check: Path | None,
    store: str,
    as_json: bool,
    **redundancy: float,
) -> None:
    """Choose nothing, a guard, a detector, re-execution or a second computer for each element of a budget.

    Campaigns LABEL... flew the elements' faults bare and with each protection. The folder has the page,
    design.json, front.csv and a campaign for each design that no other one beats. Exit status 0; of --check 1
    if what was flown lies outside a prediction.
    """
    if check is not None:
        _check(check, labels, store, as_json)
        return
    if budget is None:
        raise click.UsageError("name --budget FILE, or --check DIR")
    asked = DesignRequest(load_budget(budget), flights, RedundancyStudy.model_validate(inlined(redundancy)))
    with closing(Store(store)) as opened:
        campaigns = [opened.find(label) for label in dict.fromkeys(labels)]
        try:
            found, flying = study_designs(opened, campaigns, asked)
        except BadAirframeError as error:
            raise BadSpecError(str(error)) from error
    report.write(output, found, flying)
    click.echo(found.model_dump_json() if as_json else f"{output / report.PAGE}: {report.in_words(found)}")


def _check(folder: Path, labels: tuple[str, ...], store: str, as_json: bool) -> None:
    with closing(Store(store)) as opened:
        campaigns = [opened.find(label) for label in dict.fromkeys(labels)]
        found = check_designs(folder, [(one, list(opened.records(one))) for one in campaigns])
    for one in found:
        click.echo(one.model_dump_json() if as_json else _told(one))
    if not all(one.inside for one in found):
        sys.exit(1)


def _told(one: CheckedDesign) -> str:
    where = "inside" if one.inside else "outside"
    return (
        f"{one.design} ({one.campaign}): {where}: {one.harmed} of {one.strikes} strikes harmed, "
        f"{100 * one.flown:.3g} % ({100 * one.flown_low:.3g} to {100 * one.flown_high:.3g}); predicted "
        f"{100 * one.predicted:.3g} % ({100 * one.predicted_low:.3g} to {100 * one.predicted_high:.3g}, "
        f"level {100 * one.level:.4g} %)"
    )
