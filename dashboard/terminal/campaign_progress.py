"""A campaign at the terminal: its plan, its progress, its end."""

from __future__ import annotations

import contextlib
import json
import sys
from io import StringIO
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from dashboard.analysis import tables
from dashboard.campaigns.executors.choice import slots_of
from dashboard.campaigns.executors.spec import ExecutorSpec
from dashboard.campaigns.forecast import forecast
from dashboard.campaigns.results.summary import CellSummary, summary
from dashboard.campaigns.scheduler import Finished, Scheduler
from dashboard.campaigns.session import scheduling
from dashboard.campaigns.spec import CampaignSpec
from dashboard.campaigns.store.queries import Campaign
from dashboard.campaigns.store.store import Store

messages = Console(stderr=True)
PICTURE_COLUMNS = 90


def run_new(spec: CampaignSpec, slots: int | None, where: str, as_json: bool, svg: Path | None) -> None:
    """Store a campaign, tell what it will take, and fly it."""
    at_a_time = slots_of(spec.executor, slots, spec.limits.lease_s)
    with contextlib.closing(Store(where)) as store:
        plan = forecast(spec, store, at_a_time)
        created = store.create(spec)
        if as_json:
            click.echo(json.dumps({"campaign": created.label, "forecast": plan.model_dump()}))
        else:
            messages.print(tables.forecast(created.label, plan))
        fly(store, created, spec.executor, slots, spec.limits.disk_mb, as_json, svg)


def fly(
    store: Store,
    campaign: Campaign,
    executor: ExecutorSpec,
    slots: int | None,
    disk_mb: int,
    as_json: bool,
    svg: Path | None,
) -> None:
    """Fly what is left of a campaign while the store stays below ``disk_mb``; tell what it has found."""
    store.limit(disk_mb)
    try:
        with scheduling(store, campaign, executor, slots) as scheduler:
            if store.desired_state(campaign) == "pause":  # it was obeyed
                store.set_desired_state(campaign, "")
            _watch(scheduler, campaign, as_json)
    except KeyboardInterrupt:
        click.echo(f"zenfi: go on with: zenfi campaign resume {campaign.label}", err=True)
        raise
    tell(campaign, scheduler.states.phase, summary(store, campaign), as_json, svg)
    if scheduler.states.phase == "cancelled":
        messages.print(f"{campaign.label} was cancelled")
    if scheduler.states.phase == "paused":
        messages.print(f"{campaign.label} is paused: go on with zenfi campaign resume {campaign.label}")
    if scheduler.states.phase != "done":
        sys.exit(1)


def _watch(scheduler: Scheduler, campaign: Campaign, as_json: bool) -> None:
    states = scheduler.states
    told, arrived, proven = 0, 0, 0
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[success]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=messages) as progress:
        task = progress.add_task(
            campaign.label, total=len(states.runs), completed=states.count("done", "cancelled"), success=""
        )
        for one in scheduler.fly():
            if one.outcome is None:
                progress.console.print(
                    f"[red]not flown[/red]: {one.run.cell}, run {one.run.index}: {one.error}"
                )
            else:
                told, arrived = told + 1, arrived + one.outcome.qof.success
                proven += one.outcome.proof is not None
            progress.update(
                task,
                completed=states.count("done", "failed", "cancelled"),
                success=f"success {arrived}/{told}" + (f", {proven} proven" if proven else ""),
            )
            if as_json:
                _flight(campaign, one)


def _flight(campaign: Campaign, one: Finished) -> None:
    head: dict[str, Any] = {"campaign": campaign.label, **one.run.cell._asdict(), "index": one.run.index}
    if one.outcome is None:
        click.echo(json.dumps({**head, "error": one.error}))
    else:
        click.echo(json.dumps({**head, "outcome": one.outcome.model_dump(mode="json", by_alias=True)}))


def tell(campaign: Campaign, phase: str, lines: list[CellSummary], as_json: bool, svg: Path | None) -> None:
    """Print a summary, and draw it if asked."""
    if as_json:
        told = {"campaign": campaign.label, "phase": phase, "summary": [line.model_dump() for line in lines]}
        click.echo(json.dumps(told))
    else:
        Console().print(tables.campaign(campaign.label, lines))
        if (made := tables.effects(lines)) is not None:
            Console().print(made)
    if svg is not None:
        paper = Console(record=True, file=StringIO(), width=PICTURE_COLUMNS)
        paper.print(tables.campaign(campaign.spec.name, lines))
        paper.save_svg(str(svg), title=f"zenfi campaign run {campaign.spec.name}")
