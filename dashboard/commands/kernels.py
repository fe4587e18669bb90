"""``zenfi kernels``: what one fault does to a kernel alone (the paper's Fig. 6)."""

from __future__ import annotations

import json
import os
import time
from collections import Counter

import click
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from dashboard.campaigns.statistics.proportions import wilson
from dashboard.commands.fault import fault_fields
from dashboard.commands.options import as_json
from deploy.study import check_study, study
from services.bus.mission import FaultSpec
from services.bus.model import Strict

PAPERS = ("octomap", "rrt", "rrt_connect", "rrt_star", "pid")
RESULTS = ("benign", "sdc", "crash", "hang")


class Share(Strict):
    """How many of the injected, and the 95 % Wilson interval of their part."""

    count: int
    low: float
    high: float


class KernelSummary(Strict):
    """One kernel's outcomes."""

    kernel: str
    attempted: int
    injected: int
    shares: dict[str, Share]
    tolerable_sdc: int
    per_second: float


@click.group()
def kernels() -> None:
    """Faults in kernels alone, thousands of them."""


@kernels.command()
@click.option("--kernel", "names", multiple=True, default=PAPERS, show_default=True, help="Once for each.")
@click.option("--injections", type=click.IntRange(1, 1_000_000), default=200, show_default=True, help="Each.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--slots", type=click.IntRange(1, 256), help="At a time (default: one per processor).")
@click.option("--fault", default="", metavar="NAME=VALUE[,...]", help="What is flipped, e.g. bits=2.")
@as_json
def run(
    names: tuple[str, ...], injections: int, seed: int, slots: int | None, fault: str, as_json: bool
) -> None:
    """Strike each kernel on its recorded sample; outcomes with 95 % intervals."""
    check_study(names)
    fields = fault_fields(fault)
    faults = {name: FaultSpec.model_validate({"target": name, **fields}) for name in names}
    lines = []
    with Progress(console=Console(stderr=True)) as progress:
        for name, aimed in faults.items():
            task = progress.add_task(name, total=injections)
            found: Counter[str] = Counter()
            begin = time.monotonic()
            for one in study(name, aimed, injections, seed, slots or len(os.sched_getaffinity(0))):
                found[one.result] += 1
                found["tolerable"] += one.within_tolerance
                progress.advance(task)
                if as_json:
                    click.echo(one.model_dump_json(by_alias=True))
            lines.append(_summary(name, found, injections / (time.monotonic() - begin)))
    if as_json:
        click.echo(json.dumps({"summary": [line.model_dump() for line in lines]}))
    else:
        Console().print(_table(lines))


def _summary(kernel: str, found: Counter[str], per_second: float) -> KernelSummary:
    injected = sum(found[result] for result in RESULTS)
    shares = {}
    for result in RESULTS:
        low, high = wilson(found[result], injected)
        shares[result] = Share(count=found[result], low=low, high=high)
    return KernelSummary(
        kernel=kernel,
        attempted=injected + found["not_injected"],
        injected=injected,
        shares=shares,
        tolerable_sdc=found["tolerable"],
        per_second=per_second,
    )


def _table(lines: list[KernelSummary]) -> Table:
    title = "faults in kernels alone: % of the hit ones, 95 % Wilson; tol.: SDC within tolerance"
    table = Table(title=title, box=SIMPLE)
    for column in ("kernel", "hit", *RESULTS, "tol.", "per s"):
        table.add_column(column, justify="left" if column == "kernel" else "right")
    for line in lines:
        cells = [
            f"{100 * one.count / max(line.injected, 1):.0f} {100 * one.low:.0f}-{100 * one.high:.0f}"
            for one in line.shares.values()
        ]
        count = f"{line.injected}/{line.attempted}"
        table.add_row(line.kernel, count, *cells, str(line.tolerable_sdc), f"{line.per_second:.0f}")
    return table
