"""``zenfi campaign``: many flights, stored, resumed and compared."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from dashboard import tables
from dashboard.campaigns import export
from dashboard.campaigns.compare import Comparison, compare, with_others, with_twins
from dashboard.campaigns.events import Cancel
from dashboard.campaigns.spec import load_campaign
from dashboard.campaigns.store import BusyError, Campaign, Store, default_folder
from dashboard.commands.flying import fly, messages, run_new, summary, tell
from dashboard.commands.options import as_json
from deploy.check import BadSpecError

Command = Callable[..., Any]
in_store = click.option(
    "--store",
    type=click.Path(file_okay=False, path_type=Path),
    default=default_folder,
    show_default="$ZENFI_HOME, or ~/.local/share/zenfi",
    help="Folder of the campaigns.",
)
in_slots = click.option(
    "--slots", type=click.IntRange(1, 256), help="Flights at a time (default: one per processor)."
)
as_picture = click.option(
    "--svg", type=click.Path(dir_okay=False, writable=True, path_type=Path), help="Also draw the table."
)


@click.group()
def campaign() -> None:
    """Many flights, compared. What was flown stays in the store; what was interrupted can be resumed."""


@campaign.command()
@click.argument("spec")
@in_slots
@in_store
@as_json
@as_picture
def run(spec: str, slots: int | None, store: Path, as_json: bool, svg: Path | None) -> None:
    """Fly the campaign in the TOML or JSON file SPEC, or the preset of that name."""
    run_new(load_campaign(spec), slots, store, as_json, svg)


@campaign.command()
@click.argument("label", required=False)
@click.option("--disk-mb", type=click.IntRange(1), help="Let the store grow to this instead.")
@in_slots
@in_store
@as_json
@as_picture
def resume(
    label: str | None, disk_mb: int | None, slots: int | None, store: Path, as_json: bool, svg: Path | None
) -> None:
    """Fly what is left of the campaign LABEL (default: the last unfinished one)."""
    with contextlib.closing(Store(store)) as opened:
        if label is None:
            left = [one for one in opened.campaigns() if one.phase not in ("done", "cancelled")]
            if not left:
                message = f"nothing to resume in {store}"
                raise BadSpecError(message)
            found = left[-1]
        else:
            found = opened.find(label)
        if found.phase in ("done", "cancelled"):
            message = f"{found.label} is {found.phase}: nothing to resume"
            raise BadSpecError(message)
        limit_mb = disk_mb or found.spec.limits.disk_mb
        fly(opened, found, slots, limit_mb, as_json, svg)


@campaign.command("list")
@in_store
@as_json
def list_(store: Path, as_json: bool) -> None:
    """Every campaign of the store."""
    with contextlib.closing(Store(store)) as opened:
        lines = [_line(opened, one) for one in opened.campaigns()]
    if as_json:
        for line in lines:
            click.echo(json.dumps(line))
    else:
        Console().print(tables.campaigns(lines))


@campaign.command()
@click.argument("label")
@in_store
@as_json
@as_picture
def show(label: str, store: Path, as_json: bool, svg: Path | None) -> None:
    """What the campaign LABEL has found so far."""
    with contextlib.closing(Store(store)) as opened:
        found = opened.find(label)
        line = _line(opened, found)
        if as_json:
            click.echo(json.dumps({**line, "spec": found.spec.model_dump(mode="json")}))
        else:
            reason = f" ({line['reason']})" if line["reason"] else ""
            messages.print(f"{found.label}: {line['phase']}{reason}, {line['done']} of {line['runs']} flown")
        tell(found, line["phase"], summary(opened, found), as_json, svg)


@campaign.command()
@click.argument("label")
@in_store
def cancel(label: str, store: Path) -> None:
    """Give the campaign LABEL up; what was flown stays."""
    with contextlib.closing(Store(store)) as opened:
        found = opened.find(label)
        if found.phase in ("done", "cancelled"):
            message = f"{found.label} is {found.phase} already"
            raise BadSpecError(message)
        try:
            with opened.lock(found):
                states = opened.states(found)
                opened.write(found, states, states.handle(Cancel()), {})
        except BusyError:
            opened.wish(found, "cancel")


@campaign.command("export")
@click.argument("label")
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@in_store
def export_(label: str, file: Path, store: Path) -> None:
    """Write the campaign LABEL as a table with a row per run to FILE (.csv or .parquet)."""
    with contextlib.closing(Store(store)) as opened:
        export.write(opened.records(opened.find(label)), file)


@campaign.command("compare")
@click.argument("label")
@click.argument("other", required=False)
@click.option("--against", metavar="ARM", help="Compare every arm with this one instead of golden twins.")
@in_store
@as_json
def compare_(label: str, other: str | None, against: str | None, store: Path, as_json: bool) -> None:
    """Set flights beside flights of the same seeds.

    Each cell of the campaign LABEL is compared with its golden twins, with the arm --against, or
    with the cell of the same name of the campaign OTHER.
    """
    if other is not None and against is not None:
        raise BadSpecError("--against is for one campaign; with two, cells of the same name are compared")
    with contextlib.closing(Store(store)) as opened:
        found = opened.find(label)
        compared = _compared(opened, found, opened.find(other) if other else None, against)
    if not compared:
        message = f"{found.label}: nothing to compare: no two flights are of the same cell and seed"
        raise BadSpecError(message)
    if as_json:
        for one in compared:
            click.echo(one.model_dump_json())
    else:
        Console().print(tables.comparison(found.label, compared))


def _compared(store: Store, found: Campaign, other: Campaign | None, against: str | None) -> list[Comparison]:
    records = list(store.records(found))
    if other is not None:
        return compare(with_others(records, list(store.records(other)), other.label, lambda cell: cell))
    if against is None:
        return compare(with_twins(records))
    arms = [arm.name for arm in found.spec.arms]
    if against not in arms:
        message = f"--against: no arm {against!r}; the arms are {', '.join(arms)}"
        raise BadSpecError(message)
    others = [record for record in records if record.cell.arm != against]
    return compare(with_others(others, records, against, lambda cell: cell._replace(arm=against)))


def _line(store: Store, one: Campaign) -> dict[str, Any]:
    counts = store.progress(one)
    phase: str = one.phase
    if phase == "running" and not store.is_flying(one):
        phase = "interrupted"
    return {
        "campaign": one.label,
        "phase": phase,
        "reason": one.reason,
        "runs": sum(counts.values()),
        "done": counts["done"],
        "failed": counts["failed"],
        "created": one.created,
    }
