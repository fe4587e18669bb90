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
    """Orders for one worker, to be proven where they can be.

    The first that aims at a kernel of a golden twin tells the faults of those behind it that do, too.
    """
    ahead: dict[tuple[str, str], list[FaultSpec]] = {}
    first: dict[tuple[str, str], int] = {}
    for place, order in enumerate(orders):
        fault = order.spec.fault
        if fault is not None:
            subject = order.spec.model_copy(update={"fault": None}).model_dump_json(), fault.target
            if first.setdefault(subject, place) != place:
                ahead.setdefault(subject, []).append(fault)
    told = {place: tuple(ahead.get(subject, ())) for subject, place in first.items()}
    return [order.model_copy(update={"ahead": told.get(place, ())}) for place, order in enumerate(orders)]


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
