"""Flies harmful faults, and the same missions without a fault, and keeps what detectors would see."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from deploy.bench.detector_series import watched
from deploy.mission.fork_server import ForkServer
from detector.series.series import Series
from services.models.mission import MissionSpec
from services.models.outcome import Outcome

GOLDEN_SEED = 1 << 20
"""The first seed of golden flights: none that campaigns fly from 0 on."""


def flown_again(outcome: Outcome, server: ForkServer) -> Series | None:
    """A flight with a fault as a detector would see it; None if it does not repeat here."""
    flight, digest = watched(outcome.spec, server)
    return flight if digest == outcome.digest else None


def golden_missions(outcomes: Sequence[Outcome], count: int) -> Iterator[MissionSpec]:
    """``count`` missions without a fault: those of the outcomes in turn, each with a seed of its own."""
    missions: list[MissionSpec] = []
    for one in outcomes:
        mission = one.spec.model_copy(update={"fault": None, "detector": None, "seed": 0})
        if mission not in missions:
            missions.append(mission)
    for number in range(count):
        yield missions[number % len(missions)].model_copy(update={"seed": GOLDEN_SEED + number})
