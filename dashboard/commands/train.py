"""``zenfi train``: record error-free flights, train detectors on them, tell how well they do."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import track

from dashboard.analysis import detection
from dashboard.terminal.options import as_json
from deploy.bench.detector_series import record as fly_and_watch
from deploy.config.check import check
from deploy.config.definitions import inlined
from deploy.config.written_faults import FAULT_FORM, parse_fault
from deploy.errors import BadSpecError
from deploy.mission.fork_server import ForkServer
from detector.evaluation.evaluation import evaluate as judge
from detector.evaluation.flips import largest_changes
from detector.evaluation.lessons import save_lessons
from detector.schemes.base import Scheme
from detector.schemes.model_files import Provenance, digest, make, read_model, to_json
from detector.schemes.registry import load_detector, scheme, scheme_names, with_models
from detector.series.series import load_folder, load_series
from services.models.mission import MissionSpec

TRAINING = ("train-0.05-3", "train-0.05-5", "train-0.2-3", "train-0.2-5")
SEEDS = 25
"""The paper's: four configurations, 25 runs each."""

messages = Console(stderr=True)

data = click.option(
    "--data",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    required=True,
    metavar="DIR",
    help="Flights recorded by `zenfi train record`.",
)


class _Trainers(click.Group):
    """One command for each scheme that is installed, beside those that are written here."""

    def list_commands(self, context: click.Context) -> list[str]:
        """The commands of this group, then the schemes."""
        return [*super().list_commands(context), *scheme_names()]

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        """Ours, or the trainer of that scheme."""
        own = super().get_command(context, name)
        return own if own is not None or name not in scheme_names() else _trainer(name)


@click.group(cls=_Trainers)
def train() -> None:
    """Train and evaluate anomaly detectors."""


@train.command()
@click.option("--output", type=click.Path(file_okay=False, path_type=Path), required=True, metavar="DIR")
@click.option(
    "--world", "worlds", multiple=True, metavar="NAME|FILE.toml", help="Default: the four training worlds."
)
@click.option(
    "--seeds", type=click.IntRange(1, 2**32), default=SEEDS, show_default=True, help="0 to this, less one."
)
@click.option("--fault", metavar=FAULT_FORM, help="As in `zenfi fly`; the fault's seed is the flight's.")
@click.option("--planner", default="rrt_star", show_default=True)
@click.option("--pilot", default="guarded", show_default=True)
@click.option("--platform", default="i9-9940x", show_default=True, metavar="NAME|FILE.toml")
def record(output: Path, worlds: tuple[str, ...], seeds: int, fault: str | None, **fields: Any) -> None:
    """Fly and keep what detectors see; flights that DIR has already are not flown again."""
    specs = []
    for world in worlds or TRAINING:
        for seed in range(seeds):
            given = {"world": world, "seed": seed, **fields}
            if fault is not None:
                given["fault"] = parse_fault(fault, seed, "calls")
            specs.append(MissionSpec.model_validate(inlined(given)))
    for world_spec in specs[::seeds]:
        check(world_spec)
    output.mkdir(parents=True, exist_ok=True)
    server = ForkServer()
    try:
        for spec in track(specs, "recording", console=messages):
            _record(output, spec, server)
    finally:
        server.close()


def _record(folder: Path, spec: MissionSpec, server: ForkServer) -> None:
    fault = f"-{spec.fault.level}-{spec.fault.target}" if spec.fault is not None else ""
    pilot = f"-{spec.pilot}" if spec.pilot != MissionSpec().pilot else ""
    path = folder / f"{spec.world_name}-{spec.seed:04d}{pilot}{fault}.npz"
    if not path.exists():
        fly_and_watch(spec, server).save(path)
    elif load_series(path).spec != spec:
        message = f"{path}: holds another flight; choose another --output"
        raise BadSpecError(message)


def _trainer(name: str) -> click.Command:
    @click.command(name, help=f"Train {name!r} on error-free flights.")
    @data
    @click.option("--output", type=click.Path(dir_okay=False, path_type=Path), help=f"Default: {name}.json.")
    @click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
    @click.option(
        "--lessons",
        type=click.Path(dir_okay=False, path_type=Path),
        metavar="FILE.npz",
        help="Also write what was learned from: enough to train again.",
    )
    def trainer(data: Path, output: Path | None, seed: int, lessons: Path | None) -> None:
        _train(name, data, output or Path(f"{name}.json"), seed, lessons)

    return trainer


def _train(name: str, folder: Path, output: Path, seed: int, kept: Path | None) -> None:
    kind, flights = scheme(name), load_folder(folder)
    if any(flight.spec.fault is not None for flight in flights):
        message = f"{folder}: holds flights with a fault; train on error-free ones"
        raise BadSpecError(message)
    lessons = [kind.lesson(flight) for flight in flights]
    provenance = Provenance(
        command=f"zenfi train {name} --seed {seed}",
        worlds=sorted({flight.spec.world_name for flight in flights}),
        seeds=sorted({flight.spec.seed for flight in flights}),
        flights=len(flights),
        lessons=digest(lessons),
        seed=seed,
    )
    try:
        parameters = kind.train(lessons, seed)
    except ImportError as error:
        message = f"training {name!r} needs {error.name}: pip install 'zenfi[train]'"
        raise BadSpecError(message) from error
    output.write_text(to_json(make(name, parameters, provenance)))
    load_detector(name, output)
    if kept is not None:
        save_lessons(kept, lessons)
    messages.print(f"{output}: {name}, trained on {len(flights)} flights")


@train.command()
@data
@click.option("--scheme", "names", multiple=True, help="Default: all that have a model.")
@click.option("--model", type=click.Path(dir_okay=False, path_type=Path), help="Of the one --scheme given.")
@click.option(
    "--samples",
    type=click.IntRange(0, 1000),
    default=1,
    show_default=True,
    help="Values of each state of each golden flight in which every bit is flipped.",
)
@as_json
def evaluate(data: Path, names: tuple[str, ...], model: Path | None, samples: int, as_json: bool) -> None:
    """False alarms, flips found, ROC and delay on recorded flights, without flying."""
    if model is not None and len(names) > 1:
        message = "--model goes with one --scheme"
        raise BadSpecError(message)
    if model is not None and not names:
        names = (read_model(model).scheme,)
    flights = load_folder(data)
    largest = largest_changes([flight for flight in flights if flight.spec.fault is None])
    for name in names or with_models():
        make_one = partial(_detector, name, model)
        make_one(learning=False)
        result = judge(make_one, track(flights, name, console=messages), largest, samples)
        if as_json:
            click.echo(json.dumps({"scheme": name, **detection.as_dict(result)}))
        else:
            detection.show(Console(), name, result)


def _detector(name: str, model: Path | None, *, learning: bool) -> Scheme:
    return load_detector(name, model, learning=learning)
