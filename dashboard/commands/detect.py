"""``zenfi detect``: how many of the faults that harm a mission do detectors catch in time?"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from functools import partial
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.progress import track

from dashboard.analysis import harm_coverage
from dashboard.analysis.harm_coverage import BUDGETS, SchemeCoverage
from dashboard.campaigns.results.harmful_faults import HarmfulFault, read_collection
from dashboard.terminal.options import as_json
from deploy.bench.detector_series import watched
from deploy.bench.harmful_series import flown_again, golden_missions
from deploy.errors import BadSpecError
from deploy.mission.fork_server import ForkServer
from detector.evaluation.ablation import VARIANTS, judged_by
from detector.evaluation.coverage import HarmReport, class_of, judged
from detector.evaluation.outside_schemes import ScoringProgram, scheme_in
from detector.schemes.base import Scheme
from detector.schemes.registry import load_detector, with_models
from detector.series.series import Series, load_folder
from services.models.mission import MissionSpec
from services.models.outcome import Outcome

HARMFUL, GOLDEN = "harmful", "golden"
"""The folders of a recorded collection."""

FEWEST = 2
"""Flights below which there is nothing to divide."""

messages = Console(stderr=True)


@click.group()
def detect() -> None:
    """Judge anomaly detectors on the faults that harm missions."""


@detect.command()
@click.argument("collection", metavar="HARMFUL.jsonl", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--output", type=click.Path(file_okay=False, path_type=Path), required=True, metavar="DIR")
@click.option(
    "--golden",
    type=click.IntRange(2, 100_000),
    default=1000,
    show_default=True,
    help="Flights of the same missions without a fault, with other seeds.",
)
@click.option(
    "--part",
    default="1/1",
    show_default=True,
    metavar="K/N",
    help="Fly each N-th flight from the K-th on only, so that N such commands share the work.",
)
def record(collection: Path, output: Path, golden: int, part: str) -> None:
    """Fly a collection of `zenfi harm collect` and keep what detectors see.

    Flights that DIR has already are not flown again.
    """
    share = _share(part)
    collected = read_collection(collection)
    faults = collected[share]
    if not collected:
        message = f"{collection}: no harmful fault; zenfi harm collect LABEL --output {collection} makes one"
        raise BadSpecError(message)
    for name in (HARMFUL, GOLDEN):
        (output / name).mkdir(parents=True, exist_ok=True)
    differing = 0
    with closing(ForkServer()) as server:
        for fault in track(faults, "harmful", console=messages):
            path = output / HARMFUL / _file_of(fault.outcome.spec)
            if path.exists():
                continue
            flight = flown_again(fault.outcome, server)
            if flight is None:
                differing += 1
            else:
                Series(flight.checks, {**flight.about, "harm": report_of(fault).model_dump()}).save(path)
        missions = list(golden_missions([one.outcome for one in collected], golden))[share]
        for mission in track(missions, "golden", console=messages):
            path = output / GOLDEN / _file_of(mission)
            if not path.exists():
                watched(mission, server)[0].save(path)
    if differing:
        message = f"{collection}: {differing} of {len(faults)} flights do not repeat here and were left out"
        raise BadSpecError(message)


def _share(part: str) -> slice:
    """The flights of the part ``K/N``."""
    number, _, count = part.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        message = f"--part {part}: expected K/N, like 1/2"
        raise BadSpecError(message)
    return slice(int(number) - 1, None, int(count))


def _file_of(mission: MissionSpec) -> str:
    """The name of a flight's file: that of no other mission, and in an order that says nothing of it."""
    return f"{hashlib.blake2b(mission.model_dump_json().encode(), digest_size=16).hexdigest()}.npz"


def report_of(fault: HarmfulFault) -> HarmReport:
    """What a collection knows of a fault, for those who judge detectors."""
    outcome: Outcome = fault.outcome
    assert outcome.spec.fault is not None  # noqa: S101 - only such flights are collected
    assert outcome.injection is not None  # noqa: S101
    return HarmReport(
        struck=outcome.injection.node,
        target=fault.target,
        fault_class=class_of(outcome.spec.fault),
        pilot=outcome.spec.pilot,
        cause=fault.cause,
        injected_s=outcome.injection.virtual_time_ns / 1e9,
        harmed_at_s=fault.harmed_at_s,
    )


def _recorded(data: Path) -> list[Series]:
    """The flights that `zenfi detect record` has kept."""
    flights = [*load_folder(data / HARMFUL), *load_folder(data / GOLDEN)]
    if any("harm" not in one.about for one in flights if one.spec.fault is not None):
        what = "of which no harm is known"
    elif any("differed_s" not in one.about for one in flights):
        what = "without re-execution"
    else:
        return flights
    message = f"{data}: holds flights {what}; make them by zenfi detect record"
    raise BadSpecError(message)


def _installed(names: Sequence[str]) -> dict[str, Callable[[], Scheme]]:
    """How detectors of some schemes are made, or of all that have a model."""
    return {name: partial(load_detector, name, learning=True) for name in names or with_models()}


@detect.command()
@click.argument("data", metavar="DIR", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--scheme", "names", multiple=True, help="Default: all that have a model.")
@click.option(
    "--page", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE.md", help="Also a page."
)
@as_json
def evaluate(data: Path, names: tuple[str, ...], page: Path | None, as_json: bool) -> None:
    """Coverage of the harmful faults that `zenfi detect record` has kept in DIR, at equal false alarms.

    All schemes are compared at 0.1 false alarms a flight and at 1 in 100 hours. Half of the golden flights
    set the limit of the score, the others tell how many false alarms it gives.
    """
    flights = _recorded(data)
    makes = _installed(names)
    for make in makes.values():
        make()
    found = [_of_scheme(name, make, flights) for name, make in makes.items()]
    if as_json:
        for one in found:
            click.echo(json.dumps(harm_coverage.as_dict(one)))
    else:
        harm_coverage.show(Console(), found)
    if page is not None:
        harm_coverage.write(page, found, f"zenfi detect evaluate {data.name} --page {page.name}")


@detect.command()
@click.argument("data", metavar="DIR", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--page", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE.md", help="Also a page."
)
@click.option(
    "--variant",
    "names",
    multiple=True,
    type=click.Choice([one.name for one in VARIANTS]),
    help="Default: all.",
)
def ablation(data: Path, page: Path | None, names: tuple[str, ...]) -> None:
    """What inputs, window and preprocessing are worth to the paper's two schemes, on the flights in DIR.

    Each variant learns from a third of the golden flights and is judged like a scheme on all others.
    """
    flights = _recorded(data)
    golden = [one for one in flights if "harm" not in one.about]
    lessons, others = golden[::3], [one for number, one in enumerate(golden) if number % 3]
    harmful = [one for one in flights if "harm" in one.about]
    if not lessons:
        message = f"{data}: holds no golden flight to learn from; record more"
        raise BadSpecError(message)
    found = []
    wanted = [one for one in VARIANTS if one.name in names or not names]
    for variant in track(wanted, "variants", console=messages):
        scores = judged_by(variant, lessons, [*harmful, *others])
        found.append(
            SchemeCoverage(variant.name, None, [(budget, budget.coverage(scores)) for budget in BUDGETS])
        )
    harm_coverage.show(Console(), found)
    if page is not None:
        command = f"zenfi detect ablation {data.name} --page {page.name}"
        harm_coverage.write(page, found, command, "What inputs, window and preprocessing give")


@detect.command()
@click.argument("data", metavar="DIR", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--output", type=click.Path(file_okay=False, path_type=Path), required=True, metavar="SEALED")
@click.option("--seed", type=click.IntRange(0), help="Default: nobody knows it.")
def seal(data: Path, output: Path, seed: int | None) -> None:
    """Take half of the flights in DIR away to SEALED, drawn at random.

    What stays may be given to whoever develops a scheme; on what is sealed, `zenfi detect league` judges it.
    """
    if output.exists() and any(output.iterdir()):
        message = f"{output}: is not empty; give a new folder"
        raise BadSpecError(message)
    draw = np.random.default_rng(seed)
    for name in (HARMFUL, GOLDEN):
        files = sorted((data / name).glob("*.npz"))
        if len(files) < FEWEST:
            message = f"{data / name}: holds {len(files)} flights, too few to divide; record more"
            raise BadSpecError(message)
    for name in (HARMFUL, GOLDEN):
        (output / name).mkdir(parents=True)
        files = sorted((data / name).glob("*.npz"))
        for number in draw.choice(len(files), len(files) // 2, replace=False):
            shutil.move(files[number], output / name)
    click.echo(f"{output}: {_count(output)}; left in {data}: {_count(data)}")


def _count(data: Path) -> str:
    harmful, golden = (len(list((data / name).glob("*.npz"))) for name in (HARMFUL, GOLDEN))
    return f"{harmful} harmful and {golden} golden flights"


@detect.command()
@click.argument("entry", metavar="FOLDER|PROGRAM|NAME")
@click.option(
    "--data",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    required=True,
    metavar="SEALED",
    help="Recorded flights that nobody has seen who made the scheme: `zenfi detect seal`.",
)
@click.option(
    "--model", type=click.Path(dir_okay=False, path_type=Path), help="Default: NAME.json in FOLDER."
)
@click.option("--page", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE.md")
@as_json
def league(entry: str, data: Path, model: Path | None, page: Path | None, as_json: bool) -> None:
    """Rank a scheme among those that come along, on flights that it has not seen.

    It is that of a package's FOLDER, which need not be installed; a PROGRAM that answers scores; or one that
    is installed. Its code runs here: have it judged only if you trust it.
    """
    flights = _recorded(data)
    name, make = _entrant(entry, model)
    with _opened(make()):  # who cannot be judged is told of before anybody is
        makes = {**_installed(()), name: make}
    found = [_of_scheme(one, makes[one], flights) for one in makes]
    ranked = harm_coverage.ranked(found)
    if as_json:
        for place, one in enumerate(ranked, 1):
            click.echo(
                json.dumps({"place": place, "entry": one.scheme == name, **harm_coverage.as_dict(one)})
            )
    else:
        harm_coverage.show(Console(), ranked)
        place = [one.scheme for one in ranked].index(name) + 1
        click.echo(f"{name} is number {place} of {len(ranked)}")
    if page is not None:
        command = f"zenfi detect seal DIR --output {data.name}\n"
        command += f"zenfi detect league {Path(entry).name} --data {data.name} --page {page.name}"
        harm_coverage.write(page, ranked, command, f"League: {name} among {len(ranked) - 1} others")


def _entrant(entry: str, model: Path | None) -> tuple[str, Callable[[], Scheme | ScoringProgram]]:
    path = Path(entry)
    if path.is_dir():
        name, _ = scheme_in(path)
        return name, partial(load_detector, name, model if model is not None else path / f"{name}.json")
    if path.is_file():
        return path.stem, partial(ScoringProgram, path)
    return entry, partial(load_detector, entry, model)


def _opened(scheme: Scheme | ScoringProgram) -> AbstractContextManager[Scheme | ScoringProgram]:
    """A program ends with the context."""
    return scheme if isinstance(scheme, ScoringProgram) else nullcontext(scheme)


def _of_scheme(
    name: str, make: Callable[[], Scheme | ScoringProgram], flights: Sequence[Series]
) -> SchemeCoverage:
    scores = []
    for one in track(flights, name, console=messages):
        with _opened(make()) as scheme:
            scores.append(judged(scheme, one))
    share = harm_coverage.compute_share(name, flights)
    return SchemeCoverage(name, share, [(budget, budget.coverage(scores)) for budget in BUDGETS])
