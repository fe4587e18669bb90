"""``zenfi serve`` and ``zenfi token``: campaigns over HTTP."""

from __future__ import annotations

import contextlib
import signal
import sys
from pathlib import Path
from types import FrameType

import click

from dashboard.campaigns.store.store import Store
from dashboard.commands.campaign import in_slots
from dashboard.terminal.options import in_store


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen at.")
@click.option("--port", type=click.IntRange(1, 65_535), default=8300, show_default=True)
@click.option(
    "--allow-stack",
    "stacks",
    metavar="FILE.toml",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Programs of your own that may be asked for over HTTP; no others are run. May be repeated.",
)
@click.option(
    "--programs",
    metavar="FOLDER",
    type=click.Path(path_type=Path),
    help="Programs that may be struck: each TOML file in it is a study (zenfi program run --spec).",
)
@in_slots
@in_store
def serve(
    host: str,
    port: int,
    stacks: tuple[Path, ...],
    programs: Path | None,
    slots: int | None,
    store: str,
) -> None:
    """Serve the REST API, and fly the campaigns that it is asked for, until SIGTERM."""
    from dashboard.server import serve as run  # noqa: PLC0415 - slow to import, needed here alone

    run(store, host, port, slots, stacks, programs)


@click.command()
@click.option("--port", type=click.IntRange(0, 65_535), default=8765, show_default=True)
@in_store
def foxglove(port: int, store: str) -> None:
    """Show this machine's flights live in Foxglove, those of campaigns and of the service, until SIGTERM."""
    from dashboard.viewers.foxglove import serve as show  # noqa: PLC0415 - needed here alone

    def leave(_signal: int, _frame: FrameType | None) -> None:
        sys.exit(0)

    signal.signal(signal.SIGTERM, leave)
    with contextlib.closing(Store(store)) as opened:
        folder = opened.folder
    show(folder, port)


@click.group()
def token() -> None:
    """The token that requests must bear beyond this machine, and of its other users."""


@token.command()
@in_store
def new(store: str) -> None:
    """Make a token, print it once, keep its hash; one that was made before is void at the next start."""
    from dashboard.api.security import new_token  # noqa: PLC0415

    with contextlib.closing(Store(store)) as opened:
        click.echo(new_token(opened.folder))
