"""``zenfi replay``: do injected flights repeat?"""

from __future__ import annotations

import json
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from pathlib import Path

import click
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from dashboard.campaigns.store.store import Store
from dashboard.terminal.injected_flights import of_campaign, of_file
from dashboard.terminal.options import as_json, in_store
from deploy.mission.fork_server import ForkServer
from deploy.pairing.replay import ANSWERS, REPEATED, ReplayAnswer
from deploy.pairing.replay import replay as fly_again
from services.models.outcome import Outcome


@click.command()
@click.argument("source", metavar="FILE|LABEL[/ID]")
@in_store
@as_json
def replay(source: str, store: str, as_json: bool) -> None:
    """Fly injected flights again and compare: those of a file, of a campaign LABEL, or its run ID.

    A file has what `fly`, `campaign run` or `campaign resume` wrote with --json, or what the service tells of
    runs. Lines and runs without an injected flight are passed over and counted.

    Answers for each: replayed, relocated (the same, with memory lying elsewhere), diverged or not_reached.
    Exit status 0 if all were replayed or relocated, else 1. With --json a line for each flight says which it
    was by the run's ID, or its line in the file.
    """
    with ExitStack() as held:
        keep: Callable[[int, str], None] = _keep_nowhere
        if Path(source).is_file():
            outcomes, passed_over = of_file(Path(source))
        else:
            opened = held.enter_context(closing(Store(store)))
            outcomes, passed_over = of_campaign(opened, source)
            keep = opened.note_replay
        if passed_over:
            kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(passed_over.items()))
            click.echo(f"passed over: {passed_over.total()} ({kinds})", err=True)
        found = _flown_again(outcomes, keep, as_json)
    if not as_json:
        Console().print(_table(found))
    if any(set(answers) - REPEATED for answers in found.values()):
        sys.exit(1)


def _keep_nowhere(_number: int, _answer: str) -> None:
    """Keep no answer: flights of a file have no place for one."""


def _flown_again(
    outcomes: Mapping[int, Outcome], keep: Callable[[int, str], None], as_json: bool
) -> dict[str, Counter[ReplayAnswer]]:
    """Each flight again, told and kept as it ends; how often which answer was given, by what is struck."""
    found: dict[str, Counter[ReplayAnswer]] = defaultdict(Counter)
    console = Console(stderr=True)
    shown = Progress(console=console, transient=True, disable=not console.is_terminal)
    with closing(ForkServer()) as server, shown as progress:
        task = progress.add_task("flying again", total=len(outcomes))
        for number, outcome in outcomes.items():
            answer = fly_again(outcome, server)
            keep(number, answer.answer)
            fault = outcome.spec.fault
            assert fault is not None  # noqa: S101 - only such flights were read
            found[fault.target][answer.answer] += 1
            if as_json:
                which = {"flight": number, "struck": fault.target, "fault_seed": fault.seed}
                click.echo(json.dumps({**which, "seed": outcome.spec.seed, **answer.model_dump()}))
            elif answer.answer not in REPEATED:
                click.echo(f"{_name(outcome)}: {answer.answer}: {'; '.join(answer.differences)}")
            progress.advance(task)
    return found


def _name(outcome: Outcome) -> str:
    fault = outcome.spec.fault
    assert fault is not None  # noqa: S101 - only such flights were read
    return f"{fault.target}, seed {outcome.spec.seed}, fault seed {fault.seed}"


def _table(found: Mapping[str, Counter[ReplayAnswer]]) -> Table:
    table = Table(box=SIMPLE, show_footer=len(found) > 1)
    total = sum(found.values(), Counter[ReplayAnswer]())
    table.add_column("struck", footer="all")
    table.add_column("flights", footer=str(total.total()), justify="right")
    for answer in ANSWERS:
        table.add_column(answer.replace("_", " "), footer=str(total[answer]), justify="right")
    for target, answers in sorted(found.items()):
        table.add_row(target, str(answers.total()), *(str(answers[answer]) for answer in ANSWERS))
    return table
