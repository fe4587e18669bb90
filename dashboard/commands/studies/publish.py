"""``zenfi publish``: a campaign as a folder of pages that opens from a file or any web server."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import click

from dashboard.campaigns.store.store import Store
from dashboard.publication.site import PAGE
from dashboard.publication.site import publish as written
from dashboard.terminal.options import in_store


@click.command()
@click.argument("label")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--against", metavar="ARM", help="Compare every arm with this one instead of golden twins.")
@in_store
def publish(label: str, folder: Path, against: str | None, store: str) -> None:
    """Write the campaign LABEL as a static site into FOLDER, which is new or empty.

    It has what was found in a sentence for each cell, the figure, all cells, a page for each flight that a
    fault harmed with what replays it, and the specification. Nothing is asked of the network.
    """
    with closing(Store(store)) as opened:
        harmful = written(opened, opened.find(label), folder, against)
    click.echo(f"{folder / PAGE}: {harmful} harmful flights")
