"""``zenfi replay``: does an injected flight repeat?"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import click
from pydantic import ValidationError

from dashboard.commands.options import as_json
from deploy.check import BadSpecError, check, one_line
from deploy.forkserver import ForkServer
from deploy.replay import replay as fly_again
from services.bus.outcome import Outcome


@click.command()
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@as_json
def replay(file: Path, as_json: bool) -> None:
    """Fly the injected flights in FILE again, as `fly --json` or `campaign run --json` wrote them.

    Answers replayed, diverged or not_reached for each; exit status 0 if all were replayed, else 1.
    """
    outcomes = list(read_outcomes(file))
    for outcome in outcomes:
        check(outcome.spec)
    server = ForkServer()
    try:
        answers = []
        for outcome in outcomes:
            answers.append(fly_again(outcome, server))
            if as_json:
                click.echo(answers[-1].model_dump_json())
            else:
                click.echo(": ".join([answers[-1].answer, "; ".join(answers[-1].differences)]).rstrip(": "))
    finally:
        server.close()
    if any(one.answer != "replayed" for one in answers):
        sys.exit(1)


def read_outcomes(file: Path) -> Iterator[Outcome]:
    """The outcomes of flights with a fault, one JSON object a line.

    :raises BadSpecError: if there is none, or a line is no outcome.
    """
    found = False
    for number, line in enumerate(file.read_text().splitlines(), start=1):
        try:
            told = json.loads(line)
            if "summary" in told:
                continue
            outcome = Outcome.model_validate(told.get("outcome", told))
        except ValidationError as error:
            message = f"{file}, line {number}: {one_line(error)}"
            raise BadSpecError(message) from error
        except (ValueError, AttributeError, TypeError) as error:
            message = f"{file}, line {number}: no outcome of a flight"
            raise BadSpecError(message) from error
        if outcome.spec.fault is not None:
            found = True
            yield outcome
    if not found:
        message = f"{file}: no flight with a fault to replay"
        raise BadSpecError(message)
