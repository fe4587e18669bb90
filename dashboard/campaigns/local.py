"""The local executor: as many worker processes as slots, each on a processor of its own."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dashboard.campaigns.events import Alive, Flown, Lost, NotFlown, Started
from deploy.supervisor import InfrastructureError
from services.bus.mission import MissionSpec
from services.bus.outcome import Outcome

READ_BYTES = 1 << 16
LOSSES_IN_A_ROW = 10
"""Workers lost without a flight in between, after which the fault is not the flights'."""


@dataclass(frozen=True, slots=True)
class Task:
    """Runs that one worker is to fly one after the other, by id."""

    lease: str
    runs: Sequence[tuple[int, MissionSpec]]


@dataclass(frozen=True, slots=True)
class Report:
    """What a worker told, or what became of it."""

    event: Started | Alive | Flown | NotFlown | Lost
    outcome: Outcome | None = None


class _Slot:
    """One worker process and what it has to do."""

    def __init__(self, cpu: int, log: Path | None) -> None:
        self._cpu, self._log = cpu, log
        self.lease = ""
        self.todo: deque[tuple[int, MissionSpec]] = deque()
        self.flying: int | None = None
        self._heard = b""
        self.worker = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        with contextlib.ExitStack() as stack:
            log = stack.enter_context(self._log.open("ab")) if self._log is not None else None
            return start_worker(self._cpu, log.fileno() if log is not None else None)

    @property
    def output(self) -> int:
        assert self.worker.stdout is not None  # noqa: S101 - asked for
        return self.worker.stdout.fileno()

    def hear(self) -> list[bytes] | None:
        """Whole lines that have come; None if the worker is gone."""
        data = os.read(self.output, READ_BYTES)
        if not data:
            return None
        *lines, self._heard = (self._heard + data).split(b"\n")
        return lines

    def begin_next(self) -> int | None:
        """Send the next run; its id, None if there is none."""
        if not self.todo:
            self.lease, self.flying = "", None
            return None
        self.flying, spec = self.todo.popleft()
        assert self.worker.stdin is not None  # noqa: S101 - asked for
        with contextlib.suppress(BrokenPipeError):  # its end is heard of in a moment
            self.worker.stdin.write(spec.model_dump_json().encode() + b"\n")
            self.worker.stdin.flush()
        return self.flying

    def end(self) -> None:
        """Kill the worker; its fork server and nodes end with it."""
        self.worker.kill()
        with contextlib.suppress(BrokenPipeError):
            self.worker.communicate()

    def restart(self) -> None:
        """A new worker that knows nothing of the old one's runs."""
        self.end()
        self.lease, self.flying, self._heard = "", None, b""
        self.todo.clear()
        self.worker = self._start()


def start_worker(cpu: int, log: int | None) -> subprocess.Popen[bytes]:
    """A worker on a processor; its messages go to the file ``log``, or to ours."""
    return subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-m", "deploy.worker", str(cpu)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=log,
        start_new_session=True,
    )


class LocalExecutor:
    """Workers on this machine. ``close`` ends everything that was started."""

    def __init__(self, slots: int | None, lease_s: float, logs: Path | None = None) -> None:
        cpus = sorted(os.sched_getaffinity(0))
        self.slots = slots or len(cpus)
        self._lease_s = lease_s
        self._losses = 0
        self._crew: list[_Slot] = []
        self._selector = selectors.DefaultSelector()
        for index in range(self.slots):
            log = logs / f"worker-{index}.log" if logs is not None else None
            self._crew.append(_Slot(cpus[index % len(cpus)], log))
            self._selector.register(self._crew[-1].output, selectors.EVENT_READ, self._crew[-1])

    @property
    def leases(self) -> set[str]:
        """What is being worked on."""
        return {slot.lease for slot in self._crew if slot.lease}

    @property
    def idle(self) -> int:
        """Workers that wait for a task."""
        return sum(not slot.lease for slot in self._crew)

    def submit(self, task: Task) -> Report:
        """Give a task to an idle worker, which begins its first run."""
        slot = next(slot for slot in self._crew if not slot.lease)
        slot.lease, slot.todo = task.lease, deque(task.runs)
        return self._begun(slot)[0]

    def drop(self, lease: str) -> None:
        """End the worker that holds ``lease``; another takes its place."""
        for slot in self._crew:
            if slot.lease == lease:
                self._replace(slot)

    def poll(self, timeout_s: float) -> list[Report]:
        """What workers have told since the last call, waiting for the first for ``timeout_s``.

        :raises InfrastructureError: if workers do nothing but die.
        :raises ValueError: if a worker tells what it should not.
        """
        reports: list[Report] = []
        for key, _ in self._selector.select(timeout_s):
            slot: _Slot = key.data
            lines = slot.hear()
            if lines is None:
                reports += self._lost(slot)
                continue
            for line in lines:
                reports += self._told(slot, json.loads(line))
        return reports

    def close(self) -> None:
        """End every worker."""
        for slot in self._crew:
            slot.end()
        self._selector.close()

    def _told(self, slot: _Slot, answer: dict[str, object]) -> list[Report]:
        if slot.flying is None:
            return []
        alive = Report(Alive(slot.lease, time.monotonic() + self._lease_s))
        if "alive" in answer:
            return [alive]
        self._losses = 0
        if "error" in answer:
            ended = Report(NotFlown(slot.lease, slot.flying, str(answer["error"])))
        else:
            outcome = Outcome.model_validate(answer["outcome"])
            ended = Report(Flown(slot.lease, slot.flying), outcome)
        return [alive, ended, *self._begun(slot)]

    def _begun(self, slot: _Slot) -> list[Report]:
        lease, run = slot.lease, slot.begin_next()
        return [Report(Started(lease, run))] if run is not None else []

    def _lost(self, slot: _Slot) -> list[Report]:
        lease = slot.lease
        self._replace(slot)
        self._losses += 1
        if self._losses >= LOSSES_IN_A_ROW:
            message = f"{self._losses} workers died one after the other: see zenfi doctor"
            raise InfrastructureError(message)
        return [Report(Lost(lease, "the worker died"))] if lease else []

    def _replace(self, slot: _Slot) -> None:
        self._selector.unregister(slot.output)
        slot.restart()
        self._selector.register(slot.output, selectors.EVENT_READ, slot)
