"""``zenfi study ranks``: whether the kernels that err most alone are those that harm the mission."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from dashboard.campaigns.store.store import Store
from dashboard.studies.kernels_alone import counts_of
from dashboard.studies.ranking import RankAgreement, agreements
from dashboard.studies.ranks_page import percent
from dashboard.terminal.options import as_json, in_store
from deploy.errors import BadSpecError
from deploy.kernel_study.file import kept_runs


@click.command()
@click.argument("injections", type=click.Path(dir_okay=False, path_type=Path))
@click.argument("label")
@in_store
@as_json
def ranks(injections: Path, label: str, store: str, as_json: bool) -> None:
    """Rank kernels by silent corruption alone (file INJECTIONS) and by harm in flight (campaign LABEL).

    INJECTIONS is what `zenfi kernels run --output` or `zenfi study run fig6` keeps. Each pilot by itself.
    """
    if not injections.is_file():
        message = f"{injections}: no such file; zenfi kernels run --output {injections} makes it"
        raise BadSpecError(message)
    found = counts_of(kept_runs(injections))
    with closing(Store(store)) as opened:
        campaign = opened.find(label)
        compared = agreements(found, campaign.spec, list(opened.records(campaign)))
    if not compared:
        message = f"{label}: no fault struck a kernel's instructions; zenfi campaign run fig7 has such"
        raise BadSpecError(message)
    for judged in compared:
        if as_json:
            click.echo(judged.model_dump_json())
            continue
        Console().print(_table(judged))
        tau = "none" if judged.tau is None else f"{judged.tau:z.2f}"
        click.echo(f"Kendall's tau {tau} ({judged.low:z.2f} to {judged.high:z.2f}): {judged.verdict}")


def _table(judged: RankAgreement) -> Table:
    table = Table(title=f"{judged.pilot}: per cent, 95 % Wilson", box=None, pad_edge=False)
    for name in ("kernel", "SDC alone", "of", "harm in flight", "of"):
        table.add_column(name, justify="left" if name == "kernel" else "right")
    for one in sorted(judged.kernels, key=lambda one: -one.corrupted / one.injected):
        alone = percent(one.corrupted / one.injected, one.corrupted_low, one.corrupted_high)
        flown = percent(one.harmed / one.struck, one.harmed_low, one.harmed_high)
        table.add_row(one.kernel, alone, str(one.injected), flown, str(one.struck))
    return table
