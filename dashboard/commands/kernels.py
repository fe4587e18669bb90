"""``zenfi kernels``: what one fault does to a kernel alone (the paper's Fig. 6)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import click
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from dashboard.analysis.kernel_study import RESULTS, WAYS, KernelSummary, OutcomeShare, divided
from dashboard.studies.kernels_alone import KERNELS
from dashboard.terminal.options import as_json
from injector.kernel_study.results import StudyRun
from zenfi.kernels import kernel_studies

_GROUPS = 12


@click.group()
def kernels() -> None:
    """Faults in kernels alone, thousands of them."""


@kernels.command()
@click.option("--kernel", "names", multiple=True, default=KERNELS, show_default=True, help="Once for each.")
@click.option(
    "--injections", type=click.IntRange(1, 1_000_000), default=5000, show_default=True, help="Each."
)
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--slots", type=click.IntRange(1, 256), help="At a time (default: one per processor).")
@click.option("--fault", default="", metavar="NAME=VALUE[,...]", help="What is flipped, e.g. bits=2.")
@click.option(
    "--output", type=click.Path(dir_okay=False, path_type=Path), help="Kept here, and gone on with."
)
@click.option(
    "--by", "ways", multiple=True, type=click.Choice(list(WAYS)), help="Tables by what was corrupted."
)
@as_json
def run(
    names: tuple[str, ...],
    injections: int,
    seed: int,
    slots: int | None,
    fault: str,
    output: Path | None,
    ways: tuple[str, ...],
    as_json: bool,
) -> None:
    """Strike each kernel on its recorded sample; outcomes with 95 % intervals."""
    studies = kernel_studies(
        names, injections, seed=seed, slots=slots, fault=fault, output=output, progress=True
    )
    found: dict[str, list[StudyRun]] = {}
    summaries = []
    for study in studies:
        found[study.kernel] = study.runs
        summaries.append(study.summary)
        if as_json:
            for one in study.runs:
                click.echo(one.model_dump_json(by_alias=True))
    if as_json:
        click.echo(json.dumps({"summary": [line.model_dump() for line in summaries]}))
        return
    for table in _tables(summaries, found, ways):
        Console().print(table)


def _tables(
    summaries: list[KernelSummary], found: dict[str, list[StudyRun]], ways: tuple[str, ...]
) -> Iterator[Table]:
    yield _outcomes(summaries)
    yield _circumstances(summaries)
    for way in ways:
        for name, runs in found.items():
            table = Table(title=f"{name} by {way}", box=SIMPLE)
            for column in (way, "hit", *RESULTS):
                table.add_column(column, justify="left" if column == way else "right")
            for group, count, shares in divided(runs, way)[:_GROUPS]:
                table.add_row(group, str(count), *_cells(shares, count))
            yield table


def _outcomes(summaries: list[KernelSummary]) -> Table:
    title = "faults in kernels alone: % of the hit ones, 95 % Wilson; tol.: SDC within tolerance"
    table = Table(title=title, box=SIMPLE)
    for column in ("kernel", "hit", *RESULTS, "tol."):
        table.add_column(column, justify="left" if column == "kernel" else "right")
    for line in summaries:
        count = f"{line.injected}/{line.attempted}"
        table.add_row(line.kernel, count, *_cells(line.shares, line.injected), str(line.tolerable_sdc))
    return table


def _circumstances(summaries: list[KernelSummary]) -> Table:
    title = "how; in scope: part of the call's instructions, each drawn alike; SDC by: median, 95 %, most"
    table = Table(title=title, box=SIMPLE)
    for column in ("kernel", "precision", "in scope", "SDC by", "unit", "per s", "CPU ms each"):
        table.add_column(column, justify="left" if column in ("kernel", "unit") else "right")
    for line in summaries:
        precisions = ", ".join(f"{name} {count}" for name, count in line.precisions.items())
        apart = " ".join(f"{one:.2g}" for one in line.deviations) if line.deviations else "-"
        unit = line.unit.partition(":")[0]
        rates = f"{line.per_second:.0f}", f"{line.cpu_ms:.1f}"
        length = line.length
        scope = f"{length.scope / length.all:.0%} of {length.all:,}" if length.all else f"{length.scope:,}"
        table.add_row(line.kernel, precisions, scope, apart, unit, *rates)
    return table


def _cells(shares: dict[str, OutcomeShare], count: int) -> list[str]:
    return [
        f"{100 * one.count / max(count, 1):.0f} {100 * one.low:.0f}-{100 * one.high:.0f}"
        for one in shares.values()
    ]
