"""What is told of a stack that is up: to ``zenfi ps``, on Zenoh, to the REST service."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from deploy.compose.phases import MOVING, Phase
from services.bus.model import Strict


class ProcessView(Strict):
    """One process of a stack.

    ``processes``, ``cpu_s`` and ``memory_bytes`` are of its whole family now alive (``memory_bytes`` counts
    shared pages with each); ``cpu_percent`` is ps(1)'s: of one processor, over the time that it has run.
    ``life`` counts its starts, ``restarts`` those of them that its policy ordered. ``status`` is of the last
    end, negative for a signal. ``cleared`` counts the processes that had to be killed after their
    leader had ended, ``unkilled`` those of other users that could not be.
    """

    name: str
    phase: Phase
    wanted: bool
    since: datetime
    pid: int | None
    life: int
    restarts: int
    status: int | None
    reason: str
    processes: int
    cpu_s: float
    cpu_percent: float
    memory_bytes: int
    lost_lines: int
    cleared: int
    unkilled: int
    log: Path


class StackView(Strict):
    """One stack, told by its supervisor, whose process is ``pid``.

    ``cleared`` counts processes of an earlier life of the stack that were killed at the start, ``strays``
    those that were left by a keeper that somebody killed, ``stale`` reports of lives that were over.
    """

    name: str
    host: str
    pid: int
    since: datetime
    leaving: bool
    folder: Path
    namespace: str
    log: Path
    cleared: int
    strays: int
    stale: int
    signals: Mapping[str, int]
    processes: tuple[ProcessView, ...]

    @property
    def moving(self) -> bool:
        """Whether something is under way; else every process is ready, at rest, or waits in vain."""
        return any(one.phase in MOVING for one in self.processes)

    @property
    def amiss(self) -> list[ProcessView]:
        """The processes that failed, then those that wait for one that did."""
        return [one for phase in ("failed", "pending") for one in self.processes if one.phase == phase]
