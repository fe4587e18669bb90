"""``zenfi replay``: does an injected flight repeat?"""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path

import click
from pydantic import ValidationError

from dashboard.terminal.options import as_json
from deploy.config.check import BadSpecError, check, one_line
from deploy.mission.fork_server import ForkServer
from deploy.mission.replay import refusal
from deploy.mission.replay import replay as fly_again
from services.models.outcome import Outcome

_NOT_OURS = "not what zenfi fly, campaign run or campaign resume writes with --json"


@click.command()
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@as_json
def replay(file: Path, as_json: bool) -> None:
    """Fly the injected flights in FILE again, as `fly`, `campaign run` or `campaign resume` wrote them.

    FILE has a JSON object a line (--json). Lines without an injected flight are passed over and counted.

    Answers replayed, diverged or not_reached for each; exit status 0 if all were replayed, else 1.
    """
    outcomes, passed_over = read_outcomes(file)
    if passed_over:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(passed_over.items()))
        click.echo(f"lines passed over: {passed_over.total()} ({kinds})", err=True)
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


def read_outcomes(file: Path) -> tuple[list[Outcome], Counter[str]]:
    """The flights that can be replayed, and how many lines of each other kind there are.

    :raises BadSpecError: if there is no such flight, or a line is none of ours.
    """
    outcomes: list[Outcome] = []
    passed_over: Counter[str] = Counter()
    for number, line in enumerate(file.read_bytes().split(b"\n"), start=1):
        if not line.strip():
            continue
        try:
            found = _read(line)
        except BadSpecError as error:
            message = f"{file}, line {number}: {error}"
            raise BadSpecError(message) from error
        if isinstance(found, Outcome):
            outcomes.append(found)
        else:
            passed_over[found] += 1
    able = [one for one in outcomes if not refusal(one)]
    if not able:
        message = f"{file}: {refusal(outcomes[0]) if outcomes else 'no flight with a fault to replay'}"
        raise BadSpecError(message)
    if len(able) < len(outcomes):
        passed_over["not repeatable"] = len(outcomes) - len(able)
    return able, passed_over


def _read(line: bytes) -> Outcome | str:
    """The outcome of a flight with a fault, or what else of ours the line is.

    :raises BadSpecError: if it is none of ours.
    """
    try:
        told = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise BadSpecError("not a whole line of JSON") from error
    if not isinstance(told, dict):
        raise BadSpecError(_NOT_OURS)
    if "campaign" in told:
        for key, kind in (("forecast", "forecast"), ("summary", "summary"), ("error", "not flown")):
            if key in told:
                return kind
    flight = told.get("outcome", told)
    if flight is None:  # the service's account of a run that waits
        return "not flown"
    if flight is told and "spec" not in told:
        raise BadSpecError(_NOT_OURS)
    try:
        outcome = Outcome.model_validate(flight)
    except ValidationError as error:
        message = f"no outcome of a flight: {one_line(error)}"
        raise BadSpecError(message) from error
    if outcome.spec.fault is None:
        return "golden"
    check(outcome.spec)
    return outcome
