"""How an error passed through a flight, topic by topic: the one definition of its report."""

from __future__ import annotations

from pydantic import Field

from services.models.base import Strict


class Strayed(Strict):
    """One topic that left the golden twin's.

    A deviation is the distance between what a message says and what the twin's newest message said at that
    time, in the topic's ``unit``; None where no finite number says it.
    """

    topic: str
    stage: str
    at_ns: int = Field(description="virtual time of the first message that differs, is missing or too many")
    tick: int = Field(description="the simulator's, counted from 0")
    message: int = Field(description="number of that message, from 0")
    fields: list[str] = Field(
        description="of it that differ; empty: one flight lacks it, or its time differs"
    )
    causes: list[str] = Field(
        description="what it is made from and had strayed by then; `fault` at the struck stage"
    )
    unit: str = ""
    first: float | None = Field(default=None, description="deviation of the first message that has any")
    largest: float | None = None
    largest_at_ns: int | None = None
    last: float | None = None


class Propagation(Strict):
    """From where the fault struck to the flight command; topics in the order in which they strayed."""

    struck_at_ns: int | None = Field(description="None if nothing was struck")
    struck_stage: str = ""
    command_at_ns: int | None = Field(description="when the flight command strayed; None: never")
    topics: list[Strayed]
    same: list[str] = Field(description="topics that are the twin's to the bit")

    @property
    def delay_ns(self) -> int | None:
        """From the strike to the first flight command that strayed."""
        if self.struck_at_ns is None or self.command_at_ns is None:
            return None
        return self.command_at_ns - self.struck_at_ns
