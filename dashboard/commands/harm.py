"""``zenfi harm``: the faults that harmed a mission, collected for whoever wants to detect or prevent them."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import get_args

import click
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from dashboard.campaigns.results.harmful_faults import (
    HarmCause,
    HarmfulFault,
    distinct,
    harmful_faults,
    read_collection,
    write_collection,
)
from dashboard.campaigns.store.store import Store
from dashboard.terminal.options import as_json, in_store
from deploy.errors import BadSpecError
from services.models.oracles.harm import HARM_KINDS

CAUSES: tuple[HarmCause, ...] = get_args(HarmCause)
_HEADS = {"mission_lost": "lost", "property_violated": "rule", "too_slow": "slow"}

_file = click.Path(path_type=Path, dir_okay=False)


@click.group()
def harm() -> None:
    """Collect the faults that harmed a mission; show such a collection."""


@harm.command()
@click.argument("labels", metavar="LABEL...", nargs=-1, required=True)
@click.option(
    "--output", type=_file, default=Path("harmful.jsonl"), show_default=True, help="Kept here, and added to."
)
@in_store
@as_json
def collect(labels: tuple[str, ...], output: Path, store: str, as_json: bool) -> None:
    """Keep the injected flights of campaigns LABEL... that were harmful, each distinct fault once.

    `zenfi replay FILE` flies them again.
    """
    kept = read_collection(output)
    with closing(Store(store)) as opened:
        campaigns = [opened.find(label) for label in labels]
        found = [one for campaign in campaigns for one in harmful_faults(opened, campaign)]
    every = distinct([*kept, *found])
    write_collection(output, every)
    told = {"harmful": len(found), "new": len(every) - len(kept), "faults": len(every)}
    if as_json:
        click.echo(json.dumps(told))
        return
    click.echo(
        f"{output}: {told['faults']} faults, {told['new']} of them new; {told['harmful']} harmful flights"
    )
    if every:
        Console().print(_table(every))


@harm.command()
@click.argument("file", type=_file)
@as_json
def show(file: Path, as_json: bool) -> None:
    """What is in a collection FILE: how many faults of each target, by cause and by kind of harm."""
    found = read_collection(file)
    if not found:
        message = f"{file}: no harmful fault; zenfi harm collect LABEL --output {file} makes one"
        raise BadSpecError(message)
    if not as_json:
        Console().print(_table(found))
        return
    for one in found:
        click.echo(one.model_dump_json(by_alias=True, exclude={"outcome"}))


def _table(found: Sequence[HarmfulFault]) -> Table:
    title = "harmful faults, by what was struck"
    caption = "lost: missions; rule: a property violated; first off: the first topic that left its twin's"
    table = Table(
        box=SIMPLE, show_footer=True, title=title, caption=caption, pad_edge=False, collapse_padding=True
    )
    table.add_column("struck", footer="all", no_wrap=True)
    table.add_column("faults", footer=str(len(found)), justify="right", no_wrap=True)
    columns = [*CAUSES, *HARM_KINDS]
    total = _counted(found)
    for name in columns:
        head = _HEADS.get(name, name)
        table.add_column(head, footer=str(total[name]), justify="right", no_wrap=True)
    table.add_column("first off", no_wrap=True, max_width=16)
    for target in sorted({one.target for one in found}):
        those = [one for one in found if one.target == target]
        counts = _counted(those)
        topics = Counter(one.first_topic or "none" for one in those).most_common(1)
        first = ", ".join(f"{name} {count}" for name, count in topics)
        table.add_row(target, str(len(those)), *(str(counts[name]) for name in columns), first)
    return table


def _counted(found: Sequence[HarmfulFault]) -> Counter[str]:
    counts = Counter[str](one.cause for one in found)
    counts.update(kind for one in found for kind in one.kinds)
    return counts
