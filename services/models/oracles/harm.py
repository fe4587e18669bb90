"""Harm: what a fault did to a mission, declared once for flights, tables, exports and pages.

A flight is harmed by what holds in it and not in its golden twin: the mission is lost, a property is
violated, or it takes longer than the stated factor of the twin's time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

from pydantic import Field

from services.models.base import Strict

HarmKind = Literal["mission_lost", "property_violated", "too_slow"]
HARM_KINDS: tuple[HarmKind, ...] = get_args(HarmKind)


class HarmSpec(Strict):
    """What counts as harm beside a lost mission and violated properties."""

    time_factor: float = Field(
        default=1.5, gt=1, le=100, description="flight time beyond so many times the twin's is harm"
    )


class HarmEvent(Strict):
    """One way in which a flight was harmed, and when."""

    kind: HarmKind
    at_ns: int = Field(description="virtual time at which it held")
    property: str = Field(default="", description="the one that was violated")


def kinds(events: Sequence[HarmEvent]) -> list[HarmKind]:
    """The kinds among ``events``, each once, in the order of their table."""
    found = {event.kind for event in events}
    return [kind for kind in HARM_KINDS if kind in found]


def first_ns(events: Sequence[HarmEvent]) -> int | None:
    """When the flight was harmed first; None if it never was."""
    return min((event.at_ns for event in events), default=None)
