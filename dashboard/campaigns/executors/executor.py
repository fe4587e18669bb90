"""What flies the runs of a campaign: the interface of every executor, and what they have in common."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from dashboard.campaigns.events import Alive, Disturbed, Flown, Lost, NotFlown, RunStarted
from deploy.errors import InfrastructureError
from deploy.recording.flight_status import FlightStatus
from deploy.recording.snapshot import FlightSnapshot
from deploy.workers.protocol import WorkerAnswer, WorkerOrder, with_faults_ahead
from services.models.mission import MissionSpec
from services.models.outcome import Outcome

Ordering = Callable[[int, MissionSpec], WorkerOrder]
"""What a worker is asked for a run, by its id and specification."""

LOSSES_IN_A_ROW = 10
"""Workers lost without a flight in between, after which the fault is not the flights'."""


def unrecorded(_run: int, spec: MissionSpec) -> WorkerOrder:
    """A run that nobody wants a recording of."""
    return WorkerOrder(spec=spec)


@dataclass(frozen=True, slots=True)
class ExecutorTask:
    """Runs that one worker is to fly one after the other, by id; to ``fly_all`` none is to be proven."""

    lease: str
    runs: Sequence[tuple[int, MissionSpec]]
    fly_all: bool = False

    def orders(self, order: Ordering) -> list[tuple[int, WorkerOrder]]:
        """What the worker is asked for each run."""
        numbers = [run for run, _ in self.runs]
        orders = [order(run, spec) for run, spec in self.runs]
        return list(zip(numbers, orders if self.fly_all else with_faults_ahead(orders), strict=True))


@dataclass(frozen=True, slots=True)
class ExecutorReport:
    """What a worker told, or what became of it; ``flight`` is how a run's flight
    stands, and what it sees if it was looked at.
    """

    event: RunStarted | Alive | Flown | NotFlown | Disturbed | Lost
    outcome: Outcome | None = None
    flight: tuple[int, FlightStatus, FlightSnapshot | None] | None = None


class Executor(Protocol):
    """Flies tasks somewhere and reports; knows no campaign and no store."""

    @property
    def slots(self) -> int:
        """Flights at a time, as of now."""

    @property
    def fill(self) -> int:
        """Runs that a task should have, if they are not of one golden twin alone."""

    @property
    def leases(self) -> set[str]:
        """The leases of the tasks that workers have now."""

    @property
    def idle(self) -> int:
        """How many more tasks the executor can take now."""

    def submit(self, task: ExecutorTask) -> list[ExecutorReport]:
        """Take a task; what it has begun at once.

        :raises InfrastructureError: if it cannot, and will not.
        """

    def drop(self, lease: str) -> None:
        """Stop what is flown under ``lease``; nothing is reported of it any more."""

    def poll(self, timeout_s: float) -> list[ExecutorReport]:
        """What happened since the last call, waiting for the first for ``timeout_s``.

        :raises InfrastructureError: if nothing more can be flown here.
        :raises ValueError: if a worker tells what it should not.
        """

    def close(self) -> None:
        """End everything that was started."""


def reports(lease: str, run: int, answer: WorkerAnswer, lease_s: float) -> list[ExecutorReport]:
    """What a worker's answer means."""
    flight = (run, answer.present, answer.sight) if answer.present is not None else None
    alive = ExecutorReport(Alive(lease, time.monotonic() + lease_s), flight=flight)
    if answer.outcome is not None:
        return [alive, ExecutorReport(Flown(lease, run), answer.outcome)]
    if answer.disturbed:
        return [alive, ExecutorReport(Disturbed(lease, run, answer.error))]
    return [alive, ExecutorReport(NotFlown(lease, run, answer.error))] if answer.error else [alive]


class Losses:
    """Counts workers that die one after the other."""

    def __init__(self) -> None:
        self._count = 0

    def another(self) -> None:
        """Count one more worker that has died.

        :raises InfrastructureError: if that were too many.
        """
        self._count += 1
        if self._count >= LOSSES_IN_A_ROW:
            message = f"{self._count} workers died one after the other: see zenfi doctor"
            raise InfrastructureError(message)

    def none(self) -> None:
        """Reset the count, as a flight has ended well."""
        self._count = 0
