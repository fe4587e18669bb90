"""What a study leaves in a folder: the page, tables for other programs, the figure, and its specification."""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from dashboard.analysis import plots, results_page
from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.results import export
from dashboard.campaigns.results.compare import Comparison
from dashboard.campaigns.results.summary import CellSummary
from dashboard.campaigns.statistics.proportions import Interval
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.studies import ranks_page, recurring
from dashboard.studies.ranking import RankAgreement, harm_by_place
from dashboard.studies.study import MissionStudy
from dashboard.studies.verdict import Judged, in_words, judge
from deploy.errors import BadSpecError

PAGE, RUNS, CELLS, FINDINGS, FIGURE, SPEC = (
    "README.md",
    "runs",
    "cells",
    "findings.csv",
    "quality.svg",
    "campaign.json",
)
"""The files; tables are there as CSV and as Parquet."""

_HEADS = ("what", "unit", "paper", "ours", "low", "high", "verdict")


class StudyResults(NamedTuple):
    """All that was found by the campaign of a study; and ranks of kernels, if they were struck alone, too."""

    campaign: CampaignEntry
    records: Sequence[FlightRecord]
    lines: Sequence[CellSummary]
    compared: Sequence[Comparison]
    ranks: Sequence[RankAgreement] = ()


def write(folder: Path, study: MissionStudy, results: StudyResults) -> None:
    """Write everything that a study has found into a folder, which is made.

    :raises BadSpecError: if it cannot be written, or a package that draws or writes tables is not installed.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for ending in (".csv", ".parquet"):
            export.write(results.records, folder / f"{RUNS}{ending}")
            export.write_summary(results.lines, folder / f"{CELLS}{ending}")
        found = [judge(one, results.records) for one in study.findings]
        if found:
            _write_findings(folder / FINDINGS, found)
        if results.ranks:
            ranks_page.write(folder / ranks_page.RANKS, results.ranks)
        (folder / FIGURE).write_text(plots.svg(plots.quality(study.title, results.lines)))
        (folder / SPEC).write_text(results.campaign.spec.model_dump_json(indent=1, exclude_unset=True) + "\n")
        (folder / PAGE).write_text(page(study, results, found))
    except OSError as error:
        message = f"{folder}: {error.strerror}"
        raise BadSpecError(message) from error


def page(study: MissionStudy, results: StudyResults, found: Sequence[Judged]) -> str:
    """The page of a study: what was asked and flown, the paper's numbers beside ours, all cells."""
    parts = [f"# {study.title}", study.about, _made(study, results), f"![success and flight time]({FIGURE})"]
    if found:
        parts += ["## The paper's numbers beside ours", "\n".join(_side_by_side(found)), in_words(found)]
    if results.ranks:
        parts += ranks_page.sections(results.ranks)
    parts += recurring.sections(harm_by_place(results.campaign.spec, results.records))
    parts += results_page.tables(results.lines, results.compared)
    return "\n\n".join(parts) + "\n"


def _made(study: MissionStudy, results: StudyResults) -> str:
    """How many flights of which seeds, on what machine, in which time, and the command."""
    spec = results.campaign.spec
    flown = [one.result for one in results.records if one.result is not None]
    proven = sum(bool(one.proof) for one in flown)
    failed = sum(one.phase == "failed" for one in results.records)
    hours = sum(one.wall_s for one in flown if not one.proof) / 3600.0
    last = spec.mission.seed + (spec.seeds or spec.runs) - 1
    seeds = f"{spec.mission.seed} to {last}"
    about = (
        f"{len(flown)} runs on the seeds {seeds}; {proven} of them were proven to be the same as others, "
        f"{failed} could not be flown. They took {hours:.2f} hours of one slot on {machine()}."
    )
    again = f"zenfi study run {study.name}     # at full size\nzenfi study run {SPEC}  # this page again"
    return f"{about}\n\n```\n{again}\n```"


def machine() -> str:
    """The machine on which a page is made, in words: processors, architecture, system."""
    return f"{os.cpu_count()} processors ({platform.machine()}, {platform.system()} {platform.release()})"


def _side_by_side(found: Sequence[Judged]) -> Iterator[str]:
    yield "| | unit | paper | ours (95 %) | |"
    yield "|---|---|---|---|---|"
    for one in found:
        beside = f"{_figures(one.value.paper)} | {_between(one.ours, one.interval)}"
        yield f"| {one.value.what} | {one.value.unit} | {beside} | {one.verdict} |"


def _between(value: float | None, interval: Interval | None) -> str:
    if value is None:
        return ""
    told = _figures(value)
    return told if interval is None else f"{told} ({_figures(interval.low)} to {_figures(interval.high)})"


def _figures(value: float) -> str:
    """With a decimal, a small number with two figures: an overhead may be 0.004 %."""
    return f"{value:z.1f}" if abs(value) >= 0.1 or value == 0 else f"{value:.2g}"


def _write_findings(path: Path, found: Sequence[Judged]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(_HEADS)
        for one in found:
            ends = one.interval if one.interval is not None else (None, None)
            writer.writerow([one.value.what, one.value.unit, one.value.paper, one.ours, *ends, one.verdict])
