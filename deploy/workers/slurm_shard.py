"""A shard: runs that a batch job flies, connected to the scheduler by a shared folder only.

The job writes into a folder of its own: an answer per run, and a beat with what it is doing. Every file
appears whole or not at all. A scheduler that falls silent is not worked for any longer.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

from deploy.workers import installation
from deploy.workers.client import WorkerClient, WorkerDiedError, start_worker
from deploy.workers.protocol import ALIVE
from services.models.base import Strict
from services.system.lifeline import die_with_parent

LOOK_S = 1.0
BEAT = "beat.json"
OWNER = "scheduler.json"
"""The scheduler's beat, in the folder above the shards'."""


class Beat(Strict):
    """A sign of life: ``count`` rises. ``run`` is being flown; ``died``, ``refused``: why nothing is."""

    count: int
    run: int = -1
    died: str = ""
    refused: str = ""


def answer_file(folder: Path, run: int) -> Path:
    """The file of a run's :class:`~deploy.workers.protocol.WorkerAnswer`."""
    return folder / f"run-{run}.json"


def write(path: Path, text: str) -> None:
    """Write a file atomically, since others read it meanwhile."""
    new = path.with_suffix(".new")
    with new.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def fly_shard(folder: str, runs: Sequence[tuple[int, str]], expected: str, patience_s: float) -> None:
    """Fly missions (id, order as JSON) one after the other.

    ``expected`` is the scheduler's identity as JSON. Ends early if the scheduler has not beaten for
    ``patience_s``. Does nothing if the batch system has begun the job a second time: what it has not
    flown has been given to another.
    """
    die_with_parent()
    place = Path(folder)
    try:
        (place / "begun").touch(exist_ok=False)
    except FileExistsError:
        return
    difference = installation.Installation.model_validate_json(expected).difference(installation.own())
    if difference:
        write(place / BEAT, Beat(count=0, refused=difference).model_dump_json())
        return
    worker = WorkerClient(start_worker())
    try:
        _fly(place, runs, worker, patience_s)
    finally:
        worker.end()


def _fly(place: Path, runs: Sequence[tuple[int, str]], worker: WorkerClient, patience_s: float) -> None:
    owner = _Owner(place.parent / OWNER, patience_s)
    beat = Beat(count=0)
    for run, spec in runs:
        beat = _beaten(place, beat, run)
        try:
            for line in worker.fly(spec, LOOK_S):
                if not owner.lives():
                    return
                if line == ALIVE:
                    beat = _beaten(place, beat, run)
                elif line:
                    write(answer_file(place, run), line)
        except WorkerDiedError as error:
            _beaten(place, beat, run, str(error))
            return


def _beaten(place: Path, beat: Beat, run: int, died: str = "") -> Beat:
    new = Beat(count=beat.count + 1, run=run, died=died)
    write(place / BEAT, new.model_dump_json())
    return new


class _Owner:
    """Watches the scheduler's sign of life: clocks of machines differ, so only change counts."""

    def __init__(self, path: Path, patience_s: float) -> None:
        self._path, self._patience_s = path, patience_s
        self._beat, self._changed_s = "", time.monotonic()

    def lives(self) -> bool:
        """Whether the scheduler has given a sign of life lately."""
        try:
            beat = self._path.read_text()
        except OSError:
            beat = ""
        if beat and beat != self._beat:
            self._beat, self._changed_s = beat, time.monotonic()
        return time.monotonic() < self._changed_s + self._patience_s
