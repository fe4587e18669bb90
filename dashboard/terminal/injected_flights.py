"""Injected flights to be flown again: of a file of JSON lines, or of a store's campaign."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from pydantic import ValidationError

from dashboard.campaigns.store.listing import stored_run
from dashboard.campaigns.store.store import Store
from deploy.config.check import check
from deploy.errors import BadSpecError, one_line
from deploy.pairing.replay import refusal
from services.models.outcome import Outcome

_NOT_OURS = "not what zenfi fly, campaign run or campaign resume writes with --json"


def of_campaign(store: Store, name: str) -> tuple[dict[int, Outcome], Counter[str]]:
    """The flights of a campaign (LABEL) or of one of its runs (LABEL/ID) that can be replayed, by run.

    And how many runs of each other kind there are.

    :raises UnknownCampaignError, BadSpecError: if there is no such campaign, run or flight.
    """
    label, slash, run = name.partition("/")
    campaign = store.find(label)
    numbers = [record.id for record in store.records(campaign)]
    if slash:
        numbers = [number for number in numbers if str(number) == run]
        if not numbers:
            message = f"campaign {campaign.label} has no run {run!r}"
            raise BadSpecError(message)
    found: dict[int, Outcome | str] = {}
    for number in numbers:
        stored = stored_run(store, campaign, number)
        outcome = stored.outcome if stored is not None else None
        if outcome is None:
            found[number] = "not flown"
        else:
            found[number] = outcome if outcome.spec.fault is not None else "golden"
    return _able(name, found)


def of_file(file: Path) -> tuple[dict[int, Outcome], Counter[str]]:
    """The flights that can be replayed, by line, and how many lines of each other kind there are.

    :raises BadSpecError: if there is no such flight, or a line is none of ours.
    """
    found: dict[int, Outcome | str] = {}
    for number, line in enumerate(file.read_bytes().split(b"\n"), start=1):
        if not line.strip():
            continue
        try:
            found[number] = _read(line)
        except BadSpecError as error:
            message = f"{file}, line {number}: {error}"
            raise BadSpecError(message) from error
    return _able(str(file), found)


def _able(source: str, found: Mapping[int, Outcome | str]) -> tuple[dict[int, Outcome], Counter[str]]:
    outcomes = {number: one for number, one in found.items() if isinstance(one, Outcome)}
    passed_over = Counter(one for one in found.values() if isinstance(one, str))
    able = {number: one for number, one in outcomes.items() if not refusal(one)}
    if not able:
        reasons = [refusal(one) for one in outcomes.values()]
        message = f"{source}: {reasons[0] if reasons else 'no flight with a fault to replay'}"
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
