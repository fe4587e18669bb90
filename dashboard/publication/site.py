"""Writes the site: one page with all findings, and a page for each harmful flight with what replays it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import jinja2

from dashboard.analysis import plots
from dashboard.analysis.findings import findings
from dashboard.analysis.recordings_reader import open_run
from dashboard.analysis.why import why
from dashboard.campaigns.results import export
from dashboard.campaigns.results.compare import Comparison, side_by_side
from dashboard.campaigns.results.summary import CellSummary, summary
from dashboard.campaigns.store.listing import StoredRun, stored_run
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError
from services.models.oracles.harm import kinds
from services.models.outcome import Outcome

PAGE, RUNS, CELLS, SPEC, FLIGHTS = "index.html", "runs.csv", "cells.csv", "campaign.json", "flights"
"""What is in the folder; the last is a folder with two files for each harmful flight."""


class HarmfulFlight(NamedTuple):
    """A run that a fault harmed, its outcome, and the picture of its path (SVG), if it was recorded."""

    run: StoredRun
    outcome: Outcome
    path: str

    @property
    def harm(self) -> str:
        """The kinds of harm, in words."""
        return ", ".join(kind.replace("_", " ") for kind in kinds(self.outcome.harm or ()))


def publish(store: Store, campaign: CampaignEntry, folder: Path, against: str | None = None) -> int:
    """Write a campaign's site into a new or empty folder; the number of its harmful flights.

    Cells are compared with the arm ``against``, or with their golden twins.

    :raises BadSpecError: if the folder has something in it or cannot be written, there is no such arm, or
        matplotlib is not installed.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        message = f"{folder}: there is something already; name a new folder"
        raise BadSpecError(message)
    lines, compared = summary(store, campaign), side_by_side(store, campaign, None, against)
    harmful = list(_harmful(store, campaign))
    try:
        (folder / FLIGHTS).mkdir(parents=True)
        export.write(store.records(campaign), folder / RUNS)
        export.write_summary(lines, folder / CELLS)
        spec = campaign.spec.model_dump_json(indent=1, exclude_unset=True)
        (folder / SPEC).write_text(f"{spec}\n")
        (folder / PAGE).write_text(page(campaign, lines, compared, harmful))
        for one in harmful:
            (folder / FLIGHTS / f"{one.run.id}.html").write_text(flight_page(campaign, one))
            (folder / FLIGHTS / f"{one.run.id}.json").write_text(
                one.outcome.model_dump_json(by_alias=True) + "\n"
            )
    except OSError as error:
        message = f"{folder}: {error.strerror}"
        raise BadSpecError(message) from error
    return len(harmful)


def page(
    campaign: CampaignEntry,
    lines: Sequence[CellSummary],
    compared: Sequence[Comparison],
    harmful: Sequence[HarmfulFlight],
) -> str:
    """The first page: findings, the figure, all cells, the harmful flights, how to fly all of it again."""
    return _template(PAGE).render(
        campaign=campaign,
        findings=findings(lines, compared),
        figure=_inline(plots.svg(plots.quality(campaign.spec.name, lines))),
        lines=lines,
        harmful=harmful,
        why=why,
        files=(RUNS, CELLS, SPEC),
    )


def flight_page(campaign: CampaignEntry, flight: HarmfulFlight) -> str:
    """The page of a harmful flight: why, beside its golden twin, its messages, the injection in full."""
    record = flight.outcome.injection
    told = record.model_dump(exclude_defaults=True, by_alias=True) if record is not None else {}
    return _template("flight.html").render(
        campaign=campaign,
        flight=flight,
        outcome=flight.outcome,
        why=why(flight.outcome),
        record={name: value for name, value in told.items() if name not in ("trigger", "struck")},
    )


def _harmful(store: Store, campaign: CampaignEntry) -> Iterator[HarmfulFlight]:
    for record in store.records(campaign):
        if record.result is None or not record.result.harm:
            continue
        run = stored_run(store, campaign, record.id)
        if run is not None and run.outcome is not None:
            yield HarmfulFlight(run, run.outcome, _path(store.artefacts(campaign), run.id))


def _path(kept: Path, run: int) -> str:
    """The path of a flight beside its golden twin's, drawn; empty if it was not recorded."""
    flight, twin = kept / f"run-{run}.mcap", kept / f"run-{run}.golden.mcap"
    if not flight.is_file():
        return ""
    return _inline(plots.svg(plots.path(open_run(flight), open_run(twin) if twin.is_file() else None)))


def _inline(drawing: str) -> str:
    """A drawing without its XML head, to stand in a page."""
    return drawing[drawing.index("<svg") :]


def _template(name: str) -> jinja2.Template:
    folder = files("dashboard") / "publication"
    pages = {one: (folder / one).read_text() for one in ("layout.html", PAGE, "flight.html")}
    loader = jinja2.DictLoader(pages)
    return jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, loader=loader).get_template(
        name
    )
