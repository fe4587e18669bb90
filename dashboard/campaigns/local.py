"""The local executor: as many workers as slots, each on a processor of its own."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from dashboard.campaigns.spec import Run
from services.bus.outcome import Outcome


@dataclass(frozen=True, slots=True)
class Finished:
    """A run with its outcome, or with the line that says why we failed to fly it."""

    run: Run
    outcome: Outcome | None
    error: str = ""


class _Slot(threading.Thread):
    """One worker process and the thread that feeds it."""

    def __init__(
        self,
        cpu: int,
        todo: queue.SimpleQueue[list[Run]],
        done: queue.SimpleQueue[Finished | Exception | None],
    ) -> None:
        super().__init__(daemon=True)
        self._cpu, self._todo, self._done = cpu, todo, done
        self._worker = _start_worker(cpu)

    def run(self) -> None:
        try:
            while True:
                try:
                    group = self._todo.get_nowait()
                except queue.Empty:
                    return
                for run in group:
                    self._done.put(self._fly(run))
        except Exception as error:  # noqa: BLE001 - a bug of ours must not die with its thread
            self._done.put(error)
        finally:
            self._done.put(None)

    def _fly(self, run: Run) -> Finished:
        line = _ask(self._worker, run)
        if not line:
            self.close()
            self._worker = _start_worker(self._cpu)
            line = _ask(self._worker, run)
        if not line:
            return Finished(run, None, "the worker died, twice")
        answer = json.loads(line)
        if "error" in answer:
            return Finished(run, None, answer["error"])
        return Finished(run, Outcome.model_validate(answer["outcome"]))

    def close(self) -> None:
        """End the worker; its fork server and nodes end with it."""
        self._worker.kill()
        self._worker.communicate()


def _start_worker(cpu: int) -> subprocess.Popen[str]:
    return subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-m", "deploy.worker", str(cpu)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def _ask(worker: subprocess.Popen[str], run: Run) -> str:
    """The worker's answer, empty if it died."""
    assert worker.stdin is not None  # noqa: S101 - asked for above
    assert worker.stdout is not None  # noqa: S101 - asked for above
    with contextlib.suppress(BrokenPipeError):
        worker.stdin.write(run.spec.model_dump_json() + "\n")
        worker.stdin.flush()
    return worker.stdout.readline()


def fly_all(runs: Iterable[Run], slots: int | None = None) -> Iterator[Finished]:
    """Fly every run, yielding each as it ends. Leaving early ends everything that was started.

    The runs of one seed go to one worker, which flies their golden twin once.
    """
    cpus = sorted(os.sched_getaffinity(0))
    todo: queue.SimpleQueue[list[Run]] = queue.SimpleQueue()
    done: queue.SimpleQueue[Finished | Exception | None] = queue.SimpleQueue()
    for _, group in itertools.groupby(runs, key=lambda run: run.index):
        todo.put(list(group))
    crew: list[_Slot] = []
    try:
        crew.extend(_Slot(cpus[index % len(cpus)], todo, done) for index in range(slots or len(cpus)))
        for slot in crew:
            slot.start()
        working = len(crew)
        while working:
            finished = done.get()
            if isinstance(finished, Exception):
                raise finished
            if finished is None:
                working -= 1
            else:
                yield finished
    finally:
        for slot in crew:
            slot.close()
