"""The local executor: as many worker processes as slots, each on a processor of its own."""

from __future__ import annotations

import contextlib
import os
import selectors
from collections import deque
from pathlib import Path

from dashboard.campaigns.events import Lost, RunStarted
from dashboard.campaigns.executors.executor import (
    ExecutorReport,
    ExecutorTask,
    Losses,
    Ordering,
    reports,
    unrecorded,
)
from deploy.workers.client import WorkerClient, WorkerDiedError, start_worker
from deploy.workers.protocol import WorkerAnswer, WorkerOrder


class _Slot:
    """One worker process and what it has to do."""

    def __init__(self, cpu: int, log: Path | None, order: Ordering) -> None:
        self._cpu, self._log, self._order = cpu, log, order
        self.lease = ""
        self.todo: deque[tuple[int, WorkerOrder]] = deque()
        self.flying: int | None = None
        self.worker = self._start()

    def _start(self) -> WorkerClient:
        with contextlib.ExitStack() as stack:
            log = stack.enter_context(self._log.open("ab")) if self._log is not None else None
            file = log.fileno() if log is not None else None
            return WorkerClient(start_worker(self._cpu, file, watched=True))

    def begin_next(self) -> int | None:
        """Send the next run; its id, None if there is none."""
        if not self.todo:
            self.lease, self.flying = "", None
            return None
        self.flying, order = self.todo.popleft()
        self.worker.send(order.model_dump_json())
        return self.flying

    def take(self, task: ExecutorTask) -> None:
        """Take over the runs of a task, to begin with the next."""
        self.lease, self.todo = task.lease, deque(task.orders(self._order))

    def restart(self) -> None:
        """A new worker that knows nothing of the old one's runs."""
        self.worker.end()
        self.lease, self.flying = "", None
        self.todo.clear()
        self.worker = self._start()


class LocalExecutor:
    """Workers on this machine, ``slots`` of them (default: one per processor).

    ``order`` makes of a run's id and specification what a worker is asked.
    """

    fill = 1

    def __init__(
        self,
        slots: int | None,
        lease_s: float,
        logs: Path | None = None,
        order: Ordering = unrecorded,
    ) -> None:
        cpus = sorted(os.sched_getaffinity(0))
        self.slots = slots or len(cpus)
        self._lease_s = lease_s
        self._losses = Losses()
        self._crew: list[_Slot] = []
        self._selector = selectors.DefaultSelector()
        for index in range(self.slots):
            log = logs / f"worker-{index}.log" if logs is not None else None
            self._crew.append(_Slot(cpus[index % len(cpus)], log, order))
            self._selector.register(self._crew[-1].worker.output, selectors.EVENT_READ, self._crew[-1])

    @property
    def leases(self) -> set[str]:
        """The leases of the tasks that workers have now."""
        return {slot.lease for slot in self._crew if slot.lease}

    @property
    def idle(self) -> int:
        """Workers that wait for a task."""
        return sum(not slot.lease for slot in self._crew)

    def submit(self, task: ExecutorTask) -> list[ExecutorReport]:
        """Give a task to an idle worker, which begins its first run."""
        slot = next(slot for slot in self._crew if not slot.lease)
        slot.take(task)
        return self._begun(slot)

    def drop(self, lease: str) -> None:
        """End the worker that holds ``lease``; another takes its place."""
        for slot in self._crew:
            if slot.lease == lease:
                self._replace(slot)

    def poll(self, timeout_s: float) -> list[ExecutorReport]:
        """What workers have told since the last call, waiting for the first for ``timeout_s``."""
        told: list[ExecutorReport] = []
        for key, _ in self._selector.select(timeout_s):
            slot: _Slot = key.data
            try:
                lines = slot.worker.hear()
            except WorkerDiedError as error:
                told += self._lost(slot, str(error))
                continue
            for line in lines:
                told += self._told(slot, WorkerAnswer.model_validate_json(line))
        return told

    def close(self) -> None:
        """End every worker of this executor."""
        for slot in self._crew:
            slot.worker.end()
        self._selector.close()

    def _told(self, slot: _Slot, answer: WorkerAnswer) -> list[ExecutorReport]:
        if slot.flying is None:
            return []
        told = reports(slot.lease, slot.flying, answer, self._lease_s)
        if answer.alive:
            return told
        self._losses.none()
        return told + self._begun(slot)

    def _begun(self, slot: _Slot) -> list[ExecutorReport]:
        lease, run = slot.lease, slot.begin_next()
        return [ExecutorReport(RunStarted(lease, run))] if run is not None else []

    def _lost(self, slot: _Slot, why: str) -> list[ExecutorReport]:
        lease = slot.lease
        self._replace(slot)
        self._losses.another()
        return [ExecutorReport(Lost(lease, why))] if lease else []

    def _replace(self, slot: _Slot) -> None:
        self._selector.unregister(slot.worker.output)
        slot.restart()
        self._selector.register(slot.worker.output, selectors.EVENT_READ, slot)
