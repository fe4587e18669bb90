"""``zenfi view`` and ``zenfi propagation``: what recordings show."""

from __future__ import annotations

import contextlib
from pathlib import Path

import click
from rich.console import Console

from dashboard.analysis import tables
from dashboard.analysis.propagation import edges, picture, to_dot, with_flown_twin
from dashboard.analysis.recordings_reader import FlightRecording, open_run
from dashboard.campaigns.store.store import Store
from dashboard.terminal.options import as_json, in_store
from dashboard.viewers.viewer import VIEWERS, choose
from deploy.errors import BadSpecError

_messages = Console(stderr=True, highlight=False)


@click.command()
@click.argument("run", metavar="RUN")
@click.option(
    "--with", "viewer", type=click.Choice(list(VIEWERS)), help="Default: the first that is installed."
)
@in_store
def view(run: str, viewer: str | None, store: str) -> None:
    """Show a recording: a file, or a run of a campaign as LABEL/ID."""
    recording = _recording(run, store)
    if not recording.complete:
        _messages.print(f"{recording.path}: the flight was killed; what it left is shown")
    chosen = choose(viewer)
    program = chosen.found
    assert program is not None  # noqa: S101 - chosen because it was found
    chosen.show(program, recording.path)


@click.command()
@click.argument("run", metavar="RUN")
@click.argument("twin", metavar="[TWIN]", required=False)
@click.option(
    "--dot", type=click.Path(path_type=Path, dir_okay=False), help="Write the ways as a Graphviz file."
)
@in_store
@as_json
def propagation(run: str, twin: str | None, dot: Path | None, store: str, as_json: bool) -> None:
    """How the error of a recorded RUN passed on, topic by topic: a file, or LABEL/ID.

    TWIN is the recording of its golden twin; without one, the twin is flown.
    """
    faulty = _recording(run, store)
    golden = _recording(twin, store) if twin is not None else with_flown_twin(faulty)
    drawn = picture(faulty, golden)
    if dot is not None:
        dot.write_text(to_dot(drawn.propagation, edges(drawn.propagation)))
    if as_json:
        click.echo(drawn.model_dump_json())
    else:
        Console().print(tables.propagation(drawn.propagation))


def _recording(run: str, where: str) -> FlightRecording:
    """The recording that is named, by its file or as a run of a campaign.

    :raises BadSpecError: if there is none.
    """
    label, _, number = run.rpartition("/")
    if run.endswith(".mcap") or not label or not number.isdecimal():
        return open_run(run)
    with contextlib.closing(Store(where)) as store:
        path = store.artefacts(store.find(label)) / f"run-{int(number)}.mcap"
    if not path.is_file():
        message = f"{run}: not recorded; a campaign's `recording` says whose messages are kept"
        raise BadSpecError(message)
    return open_run(path)
