"""``zenfi study``: the experiments of the paper and of ours, from flights to pages."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from dashboard.campaigns.executors.choice import FORM, parse_executor
from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.presets import scaled
from dashboard.campaigns.results.compare import side_by_side
from dashboard.campaigns.results.summary import summary
from dashboard.campaigns.spec import CampaignSpec, load_campaign
from dashboard.campaigns.store.store import Store
from dashboard.commands.studies.design import design
from dashboard.commands.studies.map import map_
from dashboard.commands.studies.ranks import ranks
from dashboard.studies import folder, kernels_alone, kernels_page, redundant_computers, specification
from dashboard.studies.kernels_alone import KernelsAlone
from dashboard.studies.kernels_page import StudiedKernel
from dashboard.studies.ranking import RankAgreement, agreements
from dashboard.studies.redundant_computers import RedundantComputers
from dashboard.studies.specification import MODELS, Computed
from dashboard.studies.study import TABLE, MissionStudy
from dashboard.terminal.options import as_json, in_store
from deploy.errors import BadSpecError
from sim.vehicle.airframe import BadAirframeError
from zenfi.campaign import Campaign, StoredCampaign
from zenfi.kernels import kernel_studies

messages = Console(stderr=True)


@click.group()
def study() -> None:
    """Experiments of the paper and of ours: flown, judged and written as pages."""


study.add_command(design)


@study.command("list")
@as_json
def list_(as_json: bool) -> None:
    """The studies, what they are about, and how many numbers of the paper they are held against."""
    lines = [
        (KernelsAlone().name, kernels_alone.TITLE, len(kernels_alone.statements({}))),
        (RedundantComputers().name, redundant_computers.TITLE, len(redundant_computers.PAPER)),
    ]
    lines += [(one.name, one.title, len(one.findings)) for one in TABLE.values()]
    if as_json:
        for one in lines:
            click.echo(json.dumps(dict(zip(("name", "title", "findings"), one, strict=True))))
        return
    table = Table(box=None, pad_edge=False)
    for name in ("study", "paper's numbers", "about"):
        table.add_column(name)
    for name, title, findings in lines:
        table.add_row(name, str(findings or ""), title)
    Console().print(table)


@study.command()
@click.argument("name", metavar="NAME|FILE")
@click.option(
    "--scale", type=click.FloatRange(min=0, min_open=True), default=1.0, help="So many times the runs a cell."
)
@click.option(
    "--output",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Where page, tables and figure go (default: a folder of the study's name).",
)
@click.option("--executor", metavar=FORM, help="Who flies (default: local).")
@click.option("--slots", type=click.IntRange(1, 256), help="Flights at a time (default: one per processor).")
@in_store
def run(
    name: str, scale: float, output: Path | None, executor: str | None, slots: int | None, store: str
) -> None:
    """Make the study NAME, or that of a page's FILE, and write its page, tables and figure.

    What the store has of the same specification is not flown again, so an interrupted study goes on. FILE is
    campaign.json; of a study without flights it is kernels.json or redundancy.json. Where kernels are struck
    alone the folder keeps the injections.
    """
    computed = specification.load(name)
    if computed is not None:
        if executor is not None:
            message = f"--executor: {computed.name} flies nothing, and is made on this machine; leave it out"
            raise BadSpecError(message)
        _compute(computed.scaled(scale), _made(output or Path(computed.name)), slots)
        return
    spec = load_campaign(name)
    found = find(spec)
    asked = scaled(spec, scale) if scale != 1 else spec
    target = _made(output or Path(found.name))
    label = _flown_before(asked, store) or Campaign(asked).create(store=store).label
    flown = StoredCampaign(label, store)
    if flown.phase not in ("done", "cancelled"):
        at = parse_executor(executor, asked.executor) if executor is not None else None
        try:
            flown.fly(slots=slots, executor=at)
        except KeyboardInterrupt:
            messages.print("zenfi: go on with the same command")
            raise
    alone = KernelsAlone(kernels=tuple(found.alone)).scaled(scale) if found.alone else None
    struck = {one.summary.kernel: one.runs for one in _strike(alone, target, slots)} if alone else {}
    with closing(Store(store)) as opened:
        campaign = opened.find(label)
        compared = side_by_side(opened, campaign, None, found.against)
        records = list(opened.records(campaign))
        ranks = _ranks(kernels_alone.counts_of(struck), campaign.spec, records) if struck else ()
        told = folder.StudyResults(campaign, records, summary(opened, campaign), compared, ranks)
        folder.write(target, found, told)
    click.echo(f"{target / folder.PAGE}: {len(records)} runs of {label}")


def _made(target: Path) -> Path:
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"{target}: {error.strerror}"
        raise BadSpecError(message) from error
    return target


def _ranks(
    injections: Mapping[str, kernels_alone.Counts], spec: CampaignSpec, records: Sequence[FlightRecord]
) -> Sequence[RankAgreement]:
    """The ranks of kernels; none, and said, if too few were struck."""
    try:
        return agreements(injections, spec, records)
    except BadSpecError as error:
        messages.print(f"zenfi: the page has no ranks of kernels: {error}")
        return ()


def _compute(asked: Computed, target: Path, slots: int | None) -> None:
    """Make a study that flies nothing, and write its page."""
    if isinstance(asked, RedundantComputers):
        try:
            redundant_computers.write(target, asked)
        except BadAirframeError as error:
            raise BadSpecError(str(error)) from error
        click.echo(f"{target / folder.PAGE}: {len(asked.airframes)} airframes")
        return
    found = _strike(asked, target, slots)
    kernels_page.write(target, asked, found)
    attempted = sum(one.summary.attempted for one in found)
    click.echo(f"{target / folder.PAGE}: {attempted} injections into {len(found)} kernels")


def _strike(asked: KernelsAlone, target: Path, slots: int | None) -> list[StudiedKernel]:
    """Strike kernels alone; what the folder has of the same is not struck again."""
    studies = kernel_studies(
        asked.kernels,
        asked.injections,
        seed=asked.seed,
        slots=slots,
        fault=asked.fault,
        output=target / kernels_page.INJECTIONS,
        progress=True,
    )
    return [StudiedKernel(one.summary, one.runs) for one in studies]


def find(spec: CampaignSpec) -> MissionStudy:
    """The study whose flights a campaign has.

    :raises BadSpecError: if it is of none.
    """
    if spec.name not in TABLE:
        message = f"{spec.name}: no study; there are {', '.join((*MODELS, *TABLE))}"
        raise BadSpecError(message)
    return TABLE[spec.name]


def _flown_before(spec: CampaignSpec, store: str) -> str | None:
    """The newest campaign of that very specification, unless it was given up."""
    with closing(Store(store)) as opened:
        same = [one for one in opened.campaigns() if one.spec == spec and one.phase != "cancelled"]
    return same[-1].label if same else None


study.add_command(ranks)
study.add_command(map_)
