"""The lines of JSON between a worker and its client: an order for each run, answers and signs of life."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import Field, model_validator

from deploy.recording.flight_status import FlightStatus
from deploy.recording.snapshot import FlightSnapshot
from services.models.base import Strict
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.outcome import Outcome

ALIVE = '{"alive":true}'
"""The line that a worker writes every few seconds if nobody watches: it is busy, not stopped."""


class WorkerOrder(Strict):
    """A mission to fly, and the file to record it in, if it is to be recorded."""

    spec: MissionSpec
    record: Path | None = None
    live: Path | None = Field(default=None, description="socket of who shows flights while they are flown")
    about: dict[str, str] = Field(default={}, description="what the recording says beside the specification")
    flown: Path | None = Field(default=None, description="folder of outcomes that stand for others")
    ahead: tuple[FaultSpec, ...] | None = Field(
        default=None,
        description="faults of the mission that follow, to be struck with in one pass; none: fly in full",
    )


def with_faults_ahead(orders: Sequence[WorkerOrder]) -> list[WorkerOrder]:
    """Orders for one worker, each with the faults of those behind it that have the same golden twin."""
    twins = [one.spec.model_copy(update={"fault": None}).model_dump_json() for one in orders]
    found = []
    for place, order in enumerate(orders):
        behind = zip(orders[place + 1 :], twins[place + 1 :], strict=True)
        ahead = tuple(
            one.spec.fault for one, twin in behind if twin == twins[place] and one.spec.fault is not None
        )
        found.append(order.model_copy(update={"ahead": ahead}))
    return found


class WorkerAnswer(Strict):
    """One line of a worker: exactly one of ``alive``, ``outcome`` and ``error`` is set.

    With ``alive``, a worker that is watched sends the status of its flight and what it sees, if one is
    under way.
    ``error`` is our failure to fly the run; what became of the vehicle is an ``outcome``. A flight was
    ``disturbed`` if something from outside ended one of its processes: flown again, it may well succeed.
    """

    alive: bool = False
    present: FlightStatus | None = None
    sight: FlightSnapshot | None = None
    outcome: Outcome | None = None
    error: str = ""
    disturbed: bool = False

    @model_validator(mode="after")
    def _says_one_thing(self) -> WorkerAnswer:
        if self.alive + (self.outcome is not None) + bool(self.error) != 1:
            raise ValueError("expected one of alive, outcome, error")
        if self.disturbed and not self.error:
            raise ValueError("disturbed, but by what?")
        return self
