"""``zenfi campaign``: many flights, stored, resumed and compared."""

from __future__ import annotations

import contextlib
import itertools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from dashboard.analysis import results_page, tables
from dashboard.campaigns import commands
from dashboard.campaigns.executors.choice import FORM, parse_executor, slots_of
from dashboard.campaigns.executors.spec import ExecutorSpec
from dashboard.campaigns.forecast import forecast
from dashboard.campaigns.presets import presets
from dashboard.campaigns.results import export
from dashboard.campaigns.results.compare import side_by_side
from dashboard.campaigns.results.summary import summary
from dashboard.campaigns.scheduler import Finished
from dashboard.campaigns.spec import load_campaign
from dashboard.campaigns.store.listing import files, line
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from dashboard.terminal.campaign_progress import tell
from dashboard.terminal.options import as_json, in_store
from deploy.errors import BadSpecError
from zenfi.campaign import Campaign, StoredCampaign

Command = Callable[..., Any]
messages = Console(stderr=True)
in_slots = click.option(
    "--slots", type=click.IntRange(1, 256), help="Flights at a time (default: one per processor)."
)
executor_at = click.option(
    "--executor", metavar=FORM, help="Who flies (default: as the campaign's file says, else local)."
)
as_picture = click.option(
    "--svg", type=click.Path(dir_okay=False, writable=True, path_type=Path), help="Also draw the table."
)


@click.group()
def campaign() -> None:
    """Many flights, compared. What was flown stays in the store; what was interrupted can be resumed."""


@campaign.command()
@click.argument("spec")
@click.option(
    "--scale", type=click.FloatRange(min=0, min_open=True), default=1.0, help="So many times the runs a cell."
)
@click.option("--fly-all", is_flag=True, help="Fly also what can be proven by striking the node alone.")
@executor_at
@in_slots
@in_store
@as_json
@as_picture
def run(
    spec: str,
    scale: float,
    fly_all: bool,
    executor: str | None,
    slots: int | None,
    store: str,
    as_json: bool,
    svg: Path | None,
) -> None:
    """Fly the campaign in the TOML or JSON file SPEC, or the preset of that name."""
    asked = Campaign(spec, scale=scale).spec
    if fly_all:
        asked = asked.model_copy(update={"fly_all": True})
    if executor is not None:
        asked = asked.model_copy(update={"executor": parse_executor(executor, asked.executor)})
    _run_new(Campaign(asked), slots, store, as_json, svg)


@campaign.command()
@click.argument("label", required=False)
@click.option("--disk-mb", type=click.IntRange(1), help="Let the store grow to this instead.")
@executor_at
@in_slots
@in_store
@as_json
@as_picture
def resume(
    label: str | None,
    disk_mb: int | None,
    executor: str | None,
    slots: int | None,
    store: str,
    as_json: bool,
    svg: Path | None,
) -> None:
    """Fly what is left of the campaign LABEL (default: the last unfinished one)."""
    with contextlib.closing(Store(store)) as opened:
        if label is None:
            left = [one for one in opened.campaigns() if one.phase not in ("done", "cancelled")]
            if not left:
                message = f"nothing to resume in {opened.place}"
                raise BadSpecError(message)
            found = left[-1]
        else:
            found = opened.find(label)
        commands.refuse_ended(found)
        at = parse_executor(executor, found.spec.executor) if executor is not None else None
    _fly(StoredCampaign(found.label, store), at, slots, disk_mb, as_json, svg)


@campaign.command("presets")
@in_slots
@in_store
@as_json
def presets_(slots: int | None, store: str, as_json: bool) -> None:
    """The campaigns that come along: what they are, and what they take at --scale 1."""
    with contextlib.closing(Store(store)) as opened:
        plans = [
            (preset, forecast(spec, opened, slots_of(spec.executor, slots, spec.limits.lease_s)))
            for preset in presets()
            for spec in [load_campaign(preset.name)]
        ]
    if as_json:
        for preset, plan in plans:
            click.echo(json.dumps({**preset._asdict(), "forecast": plan.model_dump()}))
    else:
        Console().print(tables.presets(plans))


@campaign.command("list")
@in_store
@as_json
def list_(store: str, as_json: bool) -> None:
    """Every campaign of the store."""
    with contextlib.closing(Store(store)) as opened:
        lines = [_line(opened, one) for one in opened.campaigns()]
    if as_json:
        for one in lines:
            click.echo(json.dumps(one))
    else:
        Console().print(tables.campaigns(lines))


@campaign.command()
@click.argument("label")
@in_store
@as_json
@as_picture
def show(label: str, store: str, as_json: bool, svg: Path | None) -> None:
    """What the campaign LABEL has found so far."""
    with contextlib.closing(Store(store)) as opened:
        found = opened.find(label)
        told = _line(opened, found)
        if as_json:
            click.echo(json.dumps({**told, "spec": found.spec.model_dump(mode="json")}))
        else:
            reason = f" ({told['reason']})" if told["reason"] else ""
            messages.print(f"{found.label}: {told['phase']}{reason}, {told['done']} of {told['runs']} flown")
            if told["files"]:
                messages.print(tables.files(told["files"]))
            if told["replays"]:
                messages.print(tables.replays(told["replays"]))
        tell(found.label, found.spec.name, told["phase"], summary(opened, found), as_json, svg)


@campaign.command()
@click.argument("label")
@in_store
def cancel(label: str, store: str) -> None:
    """Give the campaign LABEL up; what was flown stays."""
    with contextlib.closing(Store(store)) as opened:
        found = opened.find(label)
        commands.cancel(opened, found)


@campaign.command()
@click.argument("label")
@in_store
def pause(label: str, store: str) -> None:
    """Leave the campaign LABEL so that it can be resumed; what is in flight is flown again then."""
    with contextlib.closing(Store(store)) as opened:
        commands.pause(opened, opened.find(label))


@campaign.command()
@click.argument("label")
@click.option("--yes", is_flag=True, help="Do not ask.")
@in_store
def delete(label: str, yes: bool, store: str) -> None:
    """Remove the campaign LABEL with its runs, results and files."""
    with contextlib.closing(Store(store)) as opened:
        found = opened.find(label)
        counts = opened.progress(found)
        if not yes:
            if not sys.stdin.isatty():
                message = f"{found.label} has {counts['done']} flown runs: to delete it, say --yes"
                raise BadSpecError(message)
            click.confirm(f"Delete {found.label} with {counts['done']} flown runs?", abort=True, err=True)
        opened.delete(found)


@campaign.command("export")
@click.argument("label")
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@in_store
def export_(label: str, file: Path, store: str) -> None:
    """Write the campaign LABEL as a table with a row per run to FILE (.csv or .parquet)."""
    with contextlib.closing(Store(store)) as opened:
        export.write(opened.records(opened.find(label)), file)


@campaign.command("compare")
@click.argument("label")
@click.argument("other", required=False)
@click.option("--against", metavar="ARM", help="Compare every arm with this one instead of golden twins.")
@click.option(
    "--page",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Write a page of results as well: FILE.md.",
)
@in_store
@as_json
def compare_(
    label: str, other: str | None, against: str | None, page: Path | None, store: str, as_json: bool
) -> None:
    """Set flights beside flights of the same seeds.

    Each cell of the campaign LABEL is compared with its golden twins, with the arm --against, or
    with the cell of the same name of the campaign OTHER.
    """
    if other is not None and against is not None:
        raise BadSpecError("--against is for one campaign; with two, cells of the same name are compared")
    with contextlib.closing(Store(store)) as opened:
        found = opened.find(label)
        compared = side_by_side(opened, found, opened.find(other) if other else None, against)
        lines = summary(opened, found)
    if not compared:
        message = f"{found.label}: nothing to compare: no two flights are of the same cell and seed"
        raise BadSpecError(message)
    if page is not None:
        told = " ".join([label, *filter(None, [other, against and f"--against {against}"])])
        results_page.write(page, found, lines, compared, f"zenfi campaign compare {told} --page {page}")
    if as_json:
        for one in compared:
            click.echo(one.model_dump_json())
    else:
        Console().print(tables.comparison(found.label, compared))


@click.group()
def store() -> None:
    """The place where campaigns are: copied, put back, checked; also while campaigns fly."""


_folder = click.Path(file_okay=False, path_type=Path)


@store.command()
@click.argument("folder", type=_folder)
@in_store
def backup(folder: Path, store: str) -> None:
    """Copy the store into the new FOLDER, which is then a store by itself."""
    from dashboard.campaigns.store.backup import back_up  # noqa: PLC0415

    with contextlib.closing(Store(store)) as opened:
        back_up(opened, folder)


@store.command()
@click.argument("folder", type=_folder)
@in_store
def restore(folder: Path, store: str) -> None:
    """Make a store of the copy in FOLDER, where there is none yet: to replace one, move it away first."""
    from dashboard.campaigns.store.backup import restore as put_back  # noqa: PLC0415

    put_back(folder, Path(store))


@store.command("check")
@in_store
@as_json
def check_(store: str, as_json: bool) -> None:
    """Read all that the store holds; exit status 1 if something of it is damaged or missing."""
    from dashboard.campaigns.store.backup import MOST_PROBLEMS, problems  # noqa: PLC0415

    with contextlib.closing(Store(store)) as opened:
        found = list(itertools.islice(problems(opened), MOST_PROBLEMS))
        for problem in found:
            click.echo(json.dumps({"problem": problem}) if as_json else problem)
        if not found:
            messages.print(f"{opened.place}: {len(opened.campaigns())} campaigns, sound", highlight=False)
    sys.exit(1 if found else 0)


@click.command()
@in_store
@as_json
@as_picture
def demo(store: str, as_json: bool, svg: Path | None) -> None:
    """A small campaign in Sparse: golden flights beside flights with one flipped bit."""
    _run_new(Campaign("demo"), None, store, as_json, svg)


def _run_new(asked: Campaign, slots: int | None, store: str, as_json: bool, svg: Path | None) -> None:
    """Store a campaign, tell what it will take, and fly it."""
    plan = asked.forecast(slots=slots, store=store)
    created = asked.create(store=store)
    if as_json:
        click.echo(json.dumps({"campaign": created.label, "forecast": plan.model_dump()}))
    else:
        messages.print(tables.forecast(created.label, plan))
    _fly(created, None, slots, None, as_json, svg)


def _fly(
    campaign: StoredCampaign,
    executor: ExecutorSpec | None,
    slots: int | None,
    disk_mb: int | None,
    as_json: bool,
    svg: Path | None,
) -> None:
    """Fly what is left of a campaign; tell what it has found."""

    def each(one: Finished) -> None:
        if as_json:
            _tell_flight(campaign.label, one)

    try:
        campaign.fly(slots=slots, executor=executor, disk_mb=disk_mb, each=each)
    except KeyboardInterrupt:
        click.echo(f"zenfi: go on with: zenfi campaign resume {campaign.label}", err=True)
        raise
    phase = campaign.phase
    tell(campaign.label, campaign.spec.name, phase, campaign.summary(), as_json, svg)
    if phase == "cancelled":
        messages.print(f"{campaign.label} was cancelled")
    if phase == "paused":
        messages.print(f"{campaign.label} is paused: go on with zenfi campaign resume {campaign.label}")
    if phase != "done":
        sys.exit(1)


def _tell_flight(label: str, one: Finished) -> None:
    head: dict[str, Any] = {"campaign": label, **one.run.cell._asdict(), "index": one.run.index}
    if one.outcome is None:
        click.echo(json.dumps({**head, "error": one.error}))
    else:
        click.echo(json.dumps({**head, "outcome": one.outcome.model_dump(mode="json", by_alias=True)}))


def _line(store: Store, one: CampaignEntry) -> dict[str, Any]:
    kept = {fate: count.model_dump() for fate, count in files(store, one).items()}
    replays = store.replay_counts(one)
    return {**line(store, one).model_dump(), "files": kept, "replays": replays}
