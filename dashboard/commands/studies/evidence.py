"""``zenfi evidence``: campaigns and a budget of upsets become failures per flight hour, as files."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import click

from dashboard.campaigns.spec import CampaignSpec
from dashboard.campaigns.store.store import Store
from dashboard.evidence import report
from dashboard.evidence.budget import load_budget
from dashboard.evidence.evidence import gather
from dashboard.evidence.rebuild import rebuild as made_again
from dashboard.terminal.options import as_json, in_store
from deploy.errors import BadSpecError
from zenfi.campaign import Campaign

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PRINT_LIMIT_S = 120.0

_folder = click.Path(file_okay=False, path_type=Path)


@click.command()
@click.argument("labels", metavar="LABEL...", nargs=-1)
@click.option(
    "--budget",
    type=click.Path(dir_okay=False, path_type=Path),
    help="TOML: how often each element is upset, and the cell that stands for it.",
)
@click.option(
    "--output", type=_folder, default=Path("evidence"), show_default=True, help="The folder that is written."
)
@click.option("--pdf", is_flag=True, help="Have an installed Chromium print the page, too.")
@click.option("--rebuild", type=_folder, help="Fly all runs of that folder again, and compare every figure.")
@in_store
@as_json
def evidence(
    labels: tuple[str, ...],
    budget: Path | None,
    output: Path,
    pdf: bool,
    rebuild: Path | None,
    store: str,
    as_json: bool,
) -> None:
    """Failures per flight hour by faults, with a bound, of campaigns LABEL... and a budget of upsets.

    The folder has the page, evidence.json, ledger.csv, faults.csv and the specifications. Exit status 0; of
    --rebuild 1 if any figure differs.
    """
    if rebuild is not None:
        _rebuild(rebuild)
        return
    if not labels or budget is None:
        raise click.UsageError("name campaigns and --budget FILE, or --rebuild DIR")
    claimed = load_budget(budget)
    with closing(Store(store)) as opened:
        campaigns = [opened.find(label) for label in dict.fromkeys(labels)]
        found = gather(opened, campaigns, claimed)
    report.write(output, found, {one.label: one.spec for one in campaigns})
    if pdf:
        print_page(output / report.PAGE)
    click.echo(found.model_dump_json() if as_json else f"{output / report.PAGE}: {report.claim(found)}")


def _rebuild(folder: Path) -> None:
    differences = made_again(folder, _fly)
    for one in differences:
        click.echo(one)
    if differences:
        sys.exit(1)
    click.echo(f"{folder}: every figure came out again")


def _fly(spec: CampaignSpec, place: Path) -> str:
    created = Campaign(spec).create(store=str(place))
    created.fly()
    return created.label


def print_page(page: Path) -> None:
    """Have a browser print a page beside itself, as PDF.

    :raises BadSpecError: if there is no browser, or it does not print.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        message = f"--pdf: none of {', '.join(BROWSERS)} is installed; print {page} from any browser"
        raise BadSpecError(message)
    target = page.with_suffix(".pdf").absolute()
    # Chromium's own sandbox does not work for root; the page is ours and loads nothing.
    alone = ["--no-sandbox"] if os.geteuid() == 0 else []
    asked = [browser, "--headless", *alone, "--no-pdf-header-footer", f"--print-to-pdf={target}"]
    try:
        subprocess.run(  # noqa: S603 - an installed browser
            [*asked, page.absolute().as_uri()], check=True, capture_output=True, timeout=PRINT_LIMIT_S
        )
    except (OSError, subprocess.SubprocessError) as error:
        message = f"--pdf: {browser} does not print {page}: {error}"
        raise BadSpecError(message) from error
