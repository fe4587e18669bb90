"""A campaign at the terminal: its progress and its end."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path

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
from dashboard.campaigns.results.summary import CellSummary

PICTURE_COLUMNS = 90


class CampaignProgress:
    """Shows how far a campaign is, in a terminal or a notebook, while it is entered."""

    def __init__(self, label: str, runs: int, ended: int, *, shown: bool = True) -> None:
        self._console = Console(stderr=True)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[success]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self._progress = Progress(*columns, console=self._console, disable=not shown)
        self._task = self._progress.add_task(label, total=runs, completed=ended, success="")
        self._flown = self._arrived = self._proven = 0

    def __enter__(self) -> CampaignProgress:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def flown(self, *, success: bool, proven: bool) -> None:
        """Count a run that has an outcome."""
        self._flown += 1
        self._arrived += success
        self._proven += proven

    def failed(self, cell: object, index: int, error: str) -> None:
        """Tell of a run that could not be flown."""
        self._console.print(f"[red]not flown[/red]: {cell}, run {index}: {error}")

    def ended(self, runs: int) -> None:
        """So many runs have ended by now."""
        success = f"success {self._arrived}/{self._flown}" + (
            f", {self._proven} proven" if self._proven else ""
        )
        self._progress.update(self._task, completed=runs, success=success)


def tell(
    label: str, name: str, phase: str, lines: list[CellSummary], as_json: bool, svg: Path | None
) -> None:
    """Print a summary, and draw it if asked."""
    if as_json:
        told = {"campaign": label, "phase": phase, "summary": [line.model_dump() for line in lines]}
        click.echo(json.dumps(told))
    else:
        Console().print(tables.campaign(label, lines))
        if (made := tables.effects(lines)) is not None:
            Console().print(made)
    if svg is not None:
        paper = Console(record=True, file=StringIO(), width=PICTURE_COLUMNS)
        paper.print(tables.campaign(name, lines))
        paper.save_svg(str(svg), title=f"zenfi campaign run {name}")
