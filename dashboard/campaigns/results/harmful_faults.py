"""Faults that harmed a mission, each once, with the flight that shows it: what detectors are to be judged on.

A collection is a file of JSON lines, one fault a line; ``zenfi replay`` flies them again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from dashboard.campaigns.store.listing import stored_run
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError
from services.bus.topics import TOPICS
from services.models.base import Strict
from services.models.faults.specification import FaultSpec
from services.models.oracles.harm import HarmKind, first_ns, kinds
from services.models.outcome import InjectionRecord, Outcome

HarmCause = Literal["data", "crash", "hang"]
"""What led to harm: wrong data, or that the node that was struck crashed or hung."""

_JUDGES = ("fault", "detector", "properties", "harm")
"""Fields of a mission that say how it is judged, and not how it is flown."""


class HarmfulFault(Strict):
    """One fault that harmed a mission, and the flight in which it did.

    ``left_at_s`` is when the first topic left its golden twin's, ``harmed_at_s`` when the flight was harmed.
    """

    campaign: str
    run: int
    target: str
    cause: HarmCause
    kinds: list[HarmKind]
    harmed_at_s: float
    first_topic: str
    left_at_s: float | None
    outcome: Outcome

    @property
    def identity(self) -> str:
        """What tells it from other faults: the mission as flown, and where and in what it was struck."""
        spec = self.outcome.spec
        mission = spec.model_dump(mode="json", exclude=set(_JUDGES))
        assert spec.fault is not None  # noqa: S101 - only such flights are collected
        assert self.outcome.injection is not None  # noqa: S101
        struck = _struck(spec.fault, self.outcome.injection)
        return json.dumps([mission, struck], sort_keys=True)


def _struck(fault: FaultSpec, record: InjectionRecord) -> dict[str, Any]:
    """Where and in what a fault struck; of one that recurs, its specification."""
    if fault.recurs:
        return fault.model_dump(mode="json", exclude={"trigger"})
    where = {"invocation", "kernel", "node", "model", "state", "point", "module", "build_id", "offset"}
    what = {"operand", "register_name", "bits", "before", "after"}
    found = record.model_dump(mode="json", include=where | what)
    return found | {"site": None if fault.trigger is None else fault.trigger.model_dump(mode="json")}


def harmful_faults(store: Store, campaign: CampaignEntry) -> Iterator[HarmfulFault]:
    """The faults that harmed a mission of a campaign, in the order of its runs."""
    for record in store.records(campaign):
        if record.result is None or not record.result.harm:
            continue
        stored = stored_run(store, campaign, record.id)
        if stored is not None and stored.outcome is not None and stored.outcome.harm:
            yield _harmful(campaign.label, record.id, stored.outcome)


def _harmful(campaign: str, run: int, outcome: Outcome) -> HarmfulFault:
    assert outcome.spec.fault is not None  # noqa: S101 - harm is told of such flights alone
    assert outcome.harm  # noqa: S101 - asked for
    topic, left_at_s = _first_left(outcome)
    return HarmfulFault(
        campaign=campaign,
        run=run,
        target=outcome.spec.fault.target,
        cause=_cause(outcome),
        kinds=kinds(outcome.harm),
        harmed_at_s=(first_ns(outcome.harm) or 0) / 1e9,
        first_topic=topic,
        left_at_s=left_at_s,
        outcome=outcome,
    )


def _cause(outcome: Outcome) -> HarmCause:
    struck = outcome.nodes.get(outcome.injection.node) if outcome.injection is not None else None
    if struck is not None and struck.hangs:
        return "hang"
    return "crash" if struck is not None and struck.crashes else "data"


def _first_left(outcome: Outcome) -> tuple[str, float | None]:
    """The topic that left its golden twin's first, and when; the first in the flow of data if several did."""
    left = [
        (report.diverged_at_s, order, name)
        for order, name in enumerate(TOPICS)
        if (report := outcome.topics.get(name)) is not None and report.diverged_at_s is not None
    ]
    if not left:
        return "", None
    left_at_s, _, name = min(left)
    return name, left_at_s


def read_collection(path: Path) -> list[HarmfulFault]:
    """The faults in a file; none if there is no such file.

    :raises BadSpecError: if it is no such file, or cannot be read.
    """
    try:
        lines = path.read_bytes().splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        message = f"{path}: {error.strerror}"
        raise BadSpecError(message) from error
    try:
        return [HarmfulFault.model_validate_json(line) for line in lines if line.strip()]
    except ValidationError as error:
        message = f"{path}: no collection of harmful faults; zenfi harm collect makes one"
        raise BadSpecError(message) from error


def distinct(found: Sequence[HarmfulFault]) -> list[HarmfulFault]:
    """Each fault once: the first of those that are the same."""
    first: dict[str, HarmfulFault] = {}
    for one in found:
        first.setdefault(one.identity, one)
    return list(first.values())


def write_collection(path: Path, found: Sequence[HarmfulFault]) -> None:
    """Write the faults to a file, all or nothing.

    :raises BadSpecError: if it cannot be written.
    """
    new = path.with_name(f"{path.name}.{os.getpid()}.new")
    try:
        new.write_text("".join(f"{one.model_dump_json(by_alias=True)}\n" for one in found))
        new.replace(path)
    except OSError as error:
        new.unlink(missing_ok=True)
        message = f"{path}: {error.strerror}"
        raise BadSpecError(message) from error
