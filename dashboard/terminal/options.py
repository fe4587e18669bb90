"""Options that several commands have: output, and the store."""

from __future__ import annotations

import click

from dashboard.campaigns.store.folder import default_folder

as_json = click.option("--json", "as_json", is_flag=True, help="One JSON object per line on standard output.")

in_store = click.option(
    "--store",
    metavar="FOLDER|URL",
    default=lambda: str(default_folder()),
    show_default="$ZENFI_HOME, or ~/.local/share/zenfi",
    help="Where the campaigns are: a folder, or postgresql://USER@HOST/DATABASE.",
)
