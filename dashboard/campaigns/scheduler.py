"""The scheduler: hands runs out to workers and writes down what becomes of them."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from dashboard.campaigns.events import Begin, Cancel, Event, Flown, Leased, LeaseTimePassed, NotNeeded, Pause
from dashboard.campaigns.executors.executor import Executor, ExecutorReport, ExecutorTask
from dashboard.campaigns.spec import Run
from dashboard.campaigns.state_machine import CampaignStates
from dashboard.campaigns.stopping import StoppingRule
from deploy.recording.flight_status import FlightStatus
from deploy.recording.snapshot import FlightSnapshot
from services.models.outcome import Outcome

POLL_S = 0.25
GROUP = 512
"""Most runs of one golden twin that are leased at a time; what their strikes share is made once a lease."""

Write = Callable[[CampaignStates, Sequence[int], Mapping[int, Outcome]], None]


@dataclass(frozen=True, slots=True)
class Finished:
    """A run with its outcome, or with the line that says why we failed to fly it."""

    id: int
    run: Run
    outcome: Outcome | None
    error: str = ""


class Scheduler:
    """Flies what is open of a campaign.

    ``write`` keeps changed states and outcomes; what it has not kept is flown again. ``desired_state`` tells
    what another process asks for, ``watch`` is told how flights stand.
    """

    def __init__(
        self,
        states: CampaignStates,
        planned: Mapping[int, Run],
        executor: Executor,
        rule: StoppingRule,
        lease_s: float,
        write: Write,
        desired_state: Callable[[], str] = lambda: "",
        *,
        fly_all: bool = False,
    ) -> None:
        self.watch: Callable[[int, FlightStatus, FlightSnapshot | None], None] = (
            lambda _run, _present, _sight: None
        )
        self.states = states
        self._planned = planned
        self._executor = executor
        self._rule = rule
        self._lease_s = lease_s
        self._write = write
        self._desired_state = desired_state
        self._fly_all = fly_all
        self._queue: deque[list[int]] = deque()
        self._serial = itertools.count()
        self._asked = ""

    def fly(self) -> Iterator[Finished]:
        """Every run that ends, as it ends."""
        self._keep(self.states.handle(Begin()), {})
        self._release()
        while self.states.phase == "running":
            self._hand_out()
            yield from self._take_in(self._executor.poll(POLL_S))
            if self.states.phase == "running" and not self._queue and not self._executor.leases:
                self._look()
            if self._asked:
                self.pause(self._asked)
            self._obey(self._desired_state())

    def stop(self, reason: str) -> None:
        """Have :meth:`fly` pause the campaign and end, within :data:`POLL_S`; from any thread."""
        self._asked = reason

    def pause(self, reason: str) -> None:
        """Leave the campaign so that it can be resumed; from the thread that flies it."""
        if self.states.phase == "running":
            self._keep(self.states.handle(Pause(reason)), {})

    def _obey(self, desired_state: str) -> None:
        if desired_state == "cancel" and self.states.phase == "running":
            self._keep(self.states.handle(Cancel()), {})
        elif desired_state == "pause":
            self.pause("paused")

    def _keep(self, changed: Sequence[int], outcomes: Mapping[int, Outcome]) -> None:
        self._write(self.states, changed, outcomes)

    def _look(self) -> None:
        if self._rule.look():
            self._keep(self.states.handle(NotNeeded()), {})
        else:
            self._release()

    def _release(self) -> None:
        """Queue what may fly by now, the runs of one golden twin together."""
        twins: dict[str, list[int]] = {}
        for index, run in self._planned.items():
            if self.states.runs[index].phase == "queued" and run.index < self._rule.released:
                twins.setdefault(run.twin.model_dump_json(), []).append(index)
        count = sum(map(len, twins.values()))
        size = max(1, min(GROUP, count // (2 * max(1, self._executor.slots))))
        for runs in twins.values():
            self._queue.extend(runs[first : first + size] for first in range(0, len(runs), size))

    def _hand_out(self) -> None:
        changed: list[int] = []
        while self._queue and self._executor.idle:
            group = self._next_group()
            lease = str(next(self._serial))
            until_s = time.monotonic() + self._lease_s
            changed += self.states.handle(Leased(lease, tuple(group), until_s))
            task = ExecutorTask(lease, [(run, self._planned[run].spec) for run in group], self._fly_all)
            for begun in self._executor.submit(task):
                changed += self.states.handle(begun.event)
        if changed:
            self._keep(changed, {})

    def _next_group(self) -> list[int]:
        """Runs to lease together: of one golden twin, and of more up to what the executor wants."""
        group = self._queue.popleft()
        while self._queue and len(group) + len(self._queue[0]) <= self._executor.fill:
            group += self._queue.popleft()
        return group

    def _take_in(self, reports: Iterable[ExecutorReport]) -> list[Finished]:
        changed: list[int] = []
        outcomes: dict[int, Outcome] = {}
        for report in reports:
            if report.flight is not None:
                self.watch(*report.flight)
            moved = self._handle(report.event)
            changed += moved
            if isinstance(report.event, Flown) and moved and report.outcome is not None:
                outcomes[report.event.run] = report.outcome
        changed += self._handle(LeaseTimePassed(time.monotonic()))
        for lease in self._executor.leases - self.states.leases:
            self._executor.drop(lease)
        if changed:
            self._keep(changed, outcomes)
        return [self._finished(run, outcomes.get(run)) for run in dict.fromkeys(changed) if self._ended(run)]

    def _handle(self, event: Event) -> list[int]:
        moved = self.states.handle(event)
        again = [run for run in moved if self.states.runs[run].phase == "queued"]
        if again:
            self._queue.appendleft(again)
        return moved

    def _ended(self, run: int) -> bool:
        return self.states.runs[run].phase in ("done", "failed")

    def _finished(self, index: int, outcome: Outcome | None) -> Finished:
        run = self._planned[index]
        if outcome is not None:
            harm = bool(outcome.harm) if outcome.harm is not None else None
            self._rule.add(run.cell, run.index, success=outcome.qof.success, harm=harm)
        return Finished(index, run, outcome, self.states.runs[index].error)
