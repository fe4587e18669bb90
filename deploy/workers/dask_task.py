"""A slot of a Dask worker: flies what a campaign's scheduler sends it.

Dask runs :func:`fly` in a thread of its pool while the task holds the resource :data:`RESOURCE`; the
missions themselves fly in a process of :mod:`deploy.workers.worker`, which dies with the Dask worker. That
process is kept for the next task, so its imports are paid for once, and ended if none comes.
"""

from __future__ import annotations

import threading
import uuid
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import distributed
from distributed.core import Status

from deploy.workers import installation
from deploy.workers.client import WorkerClient, WorkerDiedError, start_worker
from services.models.base import Strict

RESOURCE = "zenfi_slot"
TOPIC = "zenfi"
"""The topic of the events by which slots report. Campaigns share it, as Dask keeps the last 1000 of each."""

IDLE_S = 30.0
LOOK_S = 0.5


class SlotMessage(Strict):
    """A report of a slot on a run of ``task``; ``execution`` differs if Dask has begun the task again."""

    task: str
    execution: str
    kind: Literal["begun", "said", "died", "refused"]
    run: int = -1
    text: str = ""


def fly(task: str, runs: Sequence[tuple[int, str]], expected: str) -> None:
    """Fly missions (id, order as JSON) one after the other and report on them by :data:`TOPIC`.

    ``expected`` is the scheduler's :class:`~deploy.workers.installation.Installation` as JSON: with another,
    none is flown.
    """
    host = distributed.get_worker()
    execution = uuid.uuid4().hex

    def tell(kind: Literal["begun", "said", "died", "refused"], run: int = -1, text: str = "") -> None:
        message = SlotMessage(task=task, execution=execution, kind=kind, run=run, text=text)
        host.log_event(TOPIC, message.model_dump_json())

    difference = installation.Installation.model_validate_json(expected).difference(installation.own())
    if difference:
        tell("refused", text=difference)
        return
    worker = _idle_workers.take()
    kept = False
    run = -1
    try:
        for run, spec in runs:
            tell("begun", run)
            for line in worker.fly(spec, LOOK_S):
                if not _wanted(host, task):
                    return
                if line:
                    tell("said", run, line)
        kept = True
    except WorkerDiedError as error:
        tell("died", run, str(error))
    finally:
        if kept:
            _idle_workers.give_back(worker)
        else:
            worker.end()


def _wanted(host: distributed.Worker, task: str) -> bool:
    """Whether the scheduler still waits for a task: Dask itself does not stop what has begun."""
    state = host.state.tasks.get(task)
    return state is not None and state.state == "executing" and host.status == Status.running


class _IdleWorkers:
    """Worker processes that wait for the next task."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: dict[WorkerClient, threading.Timer] = {}
        # A child asks to be killed when the thread that started it ends, so that thread is one that stays.
        self._starter = ThreadPoolExecutor(1, "zenfi-starter")

    def take(self) -> WorkerClient:
        with self._lock:
            while self._idle:
                worker, timer = self._idle.popitem()
                timer.cancel()
                if worker.lives:
                    return worker
                worker.end()
        return WorkerClient(self._starter.submit(start_worker).result())

    def give_back(self, worker: WorkerClient) -> None:
        timer = threading.Timer(IDLE_S, self._dismiss, [worker])
        timer.daemon = True
        with self._lock:
            self._idle[worker] = timer
        timer.start()

    def _dismiss(self, worker: WorkerClient) -> None:
        with self._lock:
            if self._idle.pop(worker, None) is None:
                return
        worker.end()


_idle_workers = _IdleWorkers()
