"""What a worker says: one line of JSON for each run that it was given, and signs of life."""

from __future__ import annotations

from pydantic import model_validator

from deploy.present import Present
from deploy.sight import Sight
from services.bus.model import Strict
from services.bus.outcome import Outcome

ALIVE = '{"alive":true}'
"""The line that a worker says every few seconds if nobody watches: it is busy, not stopped."""


class Answer(Strict):
    """One line of a worker: exactly one of ``alive``, ``outcome`` and ``error`` is set.

    A worker that is watched tells with ``alive`` how its flight stands and what it sees, if
    one is under way.
    ``error`` is our failure to fly the run; what became of the vehicle is an ``outcome``.
    """

    alive: bool = False
    present: Present | None = None
    sight: Sight | None = None
    outcome: Outcome | None = None
    error: str = ""

    @model_validator(mode="after")
    def _says_one_thing(self) -> Answer:
        if self.alive + (self.outcome is not None) + bool(self.error) != 1:
            raise ValueError("expected one of alive, outcome, error")
        return self
