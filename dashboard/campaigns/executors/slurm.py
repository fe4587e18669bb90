"""The SLURM executor: shards as jobs of a batch system, through submitit.

A job is given its runs and a folder; what it has flown lies there as a file per run. There is no other
line between them, so a machine that dies takes nothing along but the run that it was flying.
"""

from __future__ import annotations

import contextlib
import shutil
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import submitit

from dashboard.campaigns.events import Alive, Lost, RunStarted
from dashboard.campaigns.executors.executor import ExecutorReport, ExecutorTask, Losses, reports, unrecorded
from dashboard.campaigns.executors.spec import SlurmSpec
from deploy.errors import BadSpecError, InfrastructureError
from deploy.workers import installation
from deploy.workers.protocol import WorkerAnswer
from deploy.workers.slurm_shard import BEAT, OWNER, Beat, answer_file, fly_shard, write

BEAT_S = 2.0
LOOK_S = 0.25
ASK_S = 15.0
"""Between two questions to SLURM; folders are looked at more often."""

WAITING = ("PENDING", "CONFIGURING", "REQUEUED", "SUSPENDED", "UNKNOWN")
ENDED = (
    "BOOT_FAIL",
    "CANCELLED",
    "DEADLINE",
    "FAILED",
    "INTERRUPTED",
    "NODE_FAIL",
    "OUT_OF_MEMORY",
    "PREEMPTED",
    "REVOKED",
    "TIMEOUT",
)
"""States in which a job that was heard of writes nothing more. After any other end what it wrote may yet
show up; its lease ends by itself."""


@dataclass(slots=True)
class _Shard:
    """A lease and the job that flies it."""

    job: submitit.Job[None]
    folder: Path
    todo: set[int]
    beat: Beat | None = None
    begun: set[int] = field(default_factory=set)


def batch_system(spec: SlurmSpec, folder: Path) -> submitit.Executor:
    """SLURM's end of submitit, which keeps its files in ``folder``.

    :raises BadSpecError: if this is no machine of a SLURM cluster.
    """
    try:
        jobs = submitit.SlurmExecutor(folder)
    except RuntimeError as error:
        message = "executor slurm: no srun here: start the campaign on a machine of the cluster"
        raise BadSpecError(message) from error
    given = {"partition": spec.partition, "account": spec.account}
    jobs.update_parameters(
        job_name="zenfi",
        time=spec.minutes,
        mem=f"{spec.memory_gb}GB",
        cpus_per_task=1,
        ntasks_per_node=1,
        **{name: value for name, value in given.items() if value is not None},
    )
    return jobs


Batch = Callable[[SlurmSpec, Path], submitit.Executor]


class SlurmExecutor:
    """Shards of about ``spec.shard`` runs, ``slots`` of them at a time (default: ``spec.jobs``).

    ``batch`` makes submitit's executor in a folder; tests put submitit's local one in its place.

    :raises BadSpecError: if the shared folder cannot be used, or there is no SLURM.
    """

    def __init__(
        self, spec: SlurmSpec, slots: int | None, lease_s: float, batch: Batch = batch_system
    ) -> None:
        self.slots = slots or spec.jobs
        self.fill = spec.shard
        self._lease_s = lease_s
        self._folder = Path(spec.folder) / f"zenfi-{uuid.uuid4().hex}"
        try:
            self._folder.mkdir(mode=0o700)
        except OSError as error:
            message = f"executor.folder {spec.folder}: {error.strerror}: it must be there, on every machine"
            raise BadSpecError(message) from error
        self._losses = Losses()
        self._dropped = False
        self._shards: dict[str, _Shard] = {}
        self._count = 0
        self._beat_s = self._asked_s = float("-inf")
        try:
            self._batch = batch(spec, self._folder / "jobs")
            self._beat()
        except BaseException:
            shutil.rmtree(self._folder)
            raise

    @property
    def leases(self) -> set[str]:
        """The leases of the tasks that workers have now."""
        return set(self._shards)

    @property
    def idle(self) -> int:
        """Jobs that may yet be submitted."""
        return max(0, self.slots - len(self._shards))

    def submit(self, task: ExecutorTask) -> list[ExecutorReport]:
        """Submit a job; it begins when SLURM has room for it."""
        folder = self._folder / f"shard-{task.lease}"
        folder.mkdir()
        runs = [(run, order.model_dump_json()) for run, order in task.orders(unrecorded)]
        try:
            job = self._batch.submit(fly_shard, str(folder), runs, installation.told(), self._lease_s)
        except (submitit.core.utils.FailedJobError, submitit.core.utils.FailedSubmissionError) as error:
            message = f"SLURM refuses a job: {str(error).splitlines()[0]}"
            raise InfrastructureError(message) from error
        self._shards[task.lease] = _Shard(job, folder, {run for run, _ in task.runs})
        return []

    def drop(self, lease: str) -> None:
        """Cancel the job; what it printed will be kept."""
        shard = self._shards.pop(lease, None)
        if shard is not None:
            self._dropped = True
            shard.job.cancel(check=False)

    def poll(self, timeout_s: float) -> list[ExecutorReport]:
        """What jobs have written since the last call, waiting for the first for ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while True:
            self._beat()
            told = self._look()
            left_s = deadline - time.monotonic()
            if told or left_s <= 0:
                return told
            time.sleep(min(left_s, LOOK_S))

    def close(self) -> None:
        """Cancel every job. What they printed stays in the shared folder, if one was dropped on the way."""
        for shard in self._shards.values():
            shard.job.cancel(check=False)
        self._shards.clear()
        for folder in self._folder.glob("shard-*"):
            shutil.rmtree(folder, ignore_errors=True)
        if not self._dropped:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _beat(self) -> None:
        if time.monotonic() >= self._beat_s + BEAT_S:
            self._beat_s = time.monotonic()
            self._count += 1
            write(self._folder / OWNER, Beat(count=self._count).model_dump_json())

    def _look(self) -> list[ExecutorReport]:
        ask = time.monotonic() >= self._asked_s + ASK_S
        if ask and self._shards:
            self._asked_s = time.monotonic()
            next(iter(self._shards.values())).job.get_info(mode="force")  # asks for all jobs at once
        told: list[ExecutorReport] = []
        for lease, shard in list(self._shards.items()):
            # What became of the job is asked first: what it wrote before its end is taken in all the same.
            state = shard.job.state.split(" ")[0].upper()
            told += self._read(lease, shard)
            if lease not in self._shards:
                continue
            if shard.beat is None and state in WAITING:
                told.append(ExecutorReport(Alive(lease, time.monotonic() + self._lease_s)))
            elif state in ENDED:
                told += self._lost(lease, f"the job ended: {state.lower()}")
        return told

    def _read(self, lease: str, shard: _Shard) -> list[ExecutorReport]:
        """A shard's beat, and the answers that are there."""
        told: list[ExecutorReport] = []
        beat = _beat_in(shard.folder)
        if beat is not None and beat != shard.beat:
            shard.beat = beat
            if beat.refused:
                message = f"a job of SLURM flies another zenfi: {beat.refused}; install the same everywhere"
                raise InfrastructureError(message)
            told.append(ExecutorReport(Alive(lease, time.monotonic() + self._lease_s)))
        for run in sorted(shard.todo):
            path = answer_file(shard.folder, run)
            if path.exists():
                told += self._begun(lease, shard, run)
                told += reports(lease, run, WorkerAnswer.model_validate_json(path.read_text()), self._lease_s)
                self._losses.none()
                shard.todo.discard(run)
                path.unlink()
        if beat is not None and beat.run in shard.todo:
            told += self._begun(lease, shard, beat.run)
        if not shard.todo:
            del self._shards[lease]
        elif beat is not None and beat.died:
            told += self._lost(lease, beat.died)
        return told

    def _begun(self, lease: str, shard: _Shard, run: int) -> list[ExecutorReport]:
        if run in shard.begun:
            return []
        shard.begun.add(run)
        return [ExecutorReport(RunStarted(lease, run))]

    def _lost(self, lease: str, why: str) -> list[ExecutorReport]:
        self.drop(lease)
        self._losses.another()
        return [ExecutorReport(Lost(lease, why))]


def _beat_in(folder: Path) -> Beat | None:
    with contextlib.suppress(FileNotFoundError):
        return Beat.model_validate_json((folder / BEAT).read_text())
    return None
