"""Real flights in shards, with submitit's local executor in SLURM's place."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, TypeVar

import pytest
import submitit

from dashboard.campaigns.events import Flown, Lost, RunStarted
from dashboard.campaigns.executors.executor import ExecutorReport, ExecutorTask
from dashboard.campaigns.executors.slurm import SlurmExecutor, batch_system
from dashboard.campaigns.executors.spec import SlurmSpec
from dashboard.campaigns.state_machine import CampaignStates
from deploy.errors import InfrastructureError
from deploy.workers import installation
from deploy.workers.slurm_shard import OWNER, fly_shard
from tests.conftest import descendants, wait_until
from tests.dashboard.campaigns import test_durability as durability
from tests.dashboard.campaigns.executors.flights import (
    LEASE_S,
    PLANNED,
    SHORT,
    Outcomes,
    at_the_nth_beginning,
    flown,
    nodes,
    scheduler_of,
)

PATIENCE_S = 120.0
Result = TypeVar("Result")


class LocalJobs(submitit.LocalExecutor):
    """Remembers its jobs, so that their ends can be waited for."""

    def __init__(self, _: SlurmSpec, folder: Path) -> None:
        super().__init__(folder)
        self.update_parameters(timeout_min=30)

    def submit(self, fn: Callable[..., Result], *args: Any, **kwargs: Any) -> submitit.Job[Result]:
        job = super().submit(fn, *args, **kwargs)
        STARTED.append(job)
        return job


STARTED: list[submitit.Job[Any]] = []


@pytest.fixture(autouse=True)
def _no_job_is_left() -> Iterator[None]:
    yield
    wait_until(lambda: all(job.done() for job in STARTED), PATIENCE_S)
    STARTED.clear()


def shards(folder: Path, lease_s: float = LEASE_S) -> SlurmExecutor:
    """One job at a time with all runs in one shard."""
    return SlurmExecutor(SlurmSpec(folder=str(folder), shard=100, jobs=1), None, lease_s, LocalJobs)


def until(executor: SlurmExecutor, wanted: type[object]) -> ExecutorReport:
    """The first report of a kind."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        for report in executor.poll(1.0):
            if isinstance(report.event, wanted):
                return report
    pytest.fail(f"no {wanted.__name__}")


@pytest.mark.soak
def test_the_same_outcomes_as_on_this_machine(tmp_path: Path, here: Outcomes) -> None:
    outcomes, attempts = flown(shards(tmp_path))
    assert outcomes == here
    assert set(attempts) == {1}
    assert not list(tmp_path.iterdir())


@pytest.mark.soak
@pytest.mark.parametrize("victim", ["deploy.workers.worker", "submitit.core._submit"])
def test_a_killed_job_costs_one_attempt(tmp_path: Path, here: Outcomes, victim: str) -> None:
    killed: list[int] = []

    def kill(_: CampaignStates, run: int) -> None:
        wait_until(lambda: bool(nodes()), PATIENCE_S)
        (pid,) = (
            pid
            for pid in descendants(os.getpid())
            if victim in Path(f"/proc/{pid}/cmdline").read_text().split("\0")
        )
        os.kill(pid, signal.SIGKILL)
        killed.append(run)

    outcomes, attempts = flown(shards(tmp_path, lease_s=20.0), at_the_nth_beginning(3, kill))
    assert outcomes == here
    assert killed
    # The run that was under way by then: that one, or one after it.
    assert sorted(attempts) == [1] * (len(here) - 1) + [2]
    (left,) = tmp_path.iterdir()
    assert sorted(entry.name for entry in left.iterdir()) == ["jobs", OWNER]


def test_a_preempted_job_is_lost_at_once(tmp_path: Path) -> None:
    with closing(shards(tmp_path)) as executor:
        executor.submit(ExecutorTask("a", [(n, SHORT.model_copy(update={"seed": n})) for n in range(300)]))
        until(executor, RunStarted)
        (job,) = (shard.job for shard in executor._shards.values())
        assert isinstance(job, submitit.LocalJob)
        job._interrupt()
        lost = until(executor, Lost)
        assert lost.event == Lost("a", "the job ended: interrupted")
        assert executor.idle == 1
    wait_until(lambda: not nodes(), PATIENCE_S / 2)


@pytest.mark.soak
def test_paused_work_ends(tmp_path: Path) -> None:
    with closing(shards(tmp_path)) as executor:
        scheduler = scheduler_of(executor)
        flights = scheduler.fly()
        next(flights)
        threading.Thread(target=scheduler.stop, args=["enough"]).start()
        list(flights)
        assert scheduler.states.phase == "paused"
    wait_until(lambda: not nodes(), PATIENCE_S / 2)


def a_shard(folder: Path, patience_s: float, expected: str | None = None) -> list[str]:
    """What is in a shard's folder after its job has flown in a process of its own."""
    runs = [(run, planned.spec.model_dump_json()) for run, planned in PLANNED.items()]
    arguments = (str(folder), runs, expected or installation.told(), patience_s)
    script = f"from deploy.workers.slurm_shard import fly_shard\nfly_shard(*{arguments!r})"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=PATIENCE_S)
    return sorted(entry.name for entry in folder.iterdir())


def test_a_shard_whose_scheduler_is_silent_ends(tmp_path: Path) -> None:
    folder = tmp_path / "shard-0"
    folder.mkdir()
    (tmp_path / OWNER).write_text("once")
    flown = [name for name in a_shard(folder, 0.01) if name.startswith("run-")]
    assert len(flown) < len(PLANNED)


def test_a_job_that_slurm_begins_again_flies_nothing(tmp_path: Path) -> None:
    (tmp_path / "begun").touch()
    fly_shard(str(tmp_path), [(0, SHORT.model_dump_json())], installation.told(), LEASE_S)
    assert [entry.name for entry in tmp_path.iterdir()] == ["begun"]


def test_a_job_of_another_version_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    newer = installation.own().model_copy(update={"zenfi": "9.9"})
    monkeypatch.setattr(installation, "told", newer.model_dump_json)
    executor = shards(tmp_path)
    with closing(executor), pytest.raises(InfrastructureError, match=r"another zenfi: zenfi is .* 9\.9 here"):
        list(scheduler_of(executor).fly())


def test_answers_of_a_shard_are_checked(tmp_path: Path) -> None:
    with closing(shards(tmp_path)) as executor:
        executor.submit(ExecutorTask("a", [(0, SHORT)]))
        (folder,) = tmp_path.glob("*/shard-a")
        (folder / "run-0.json").write_text('{"outcome": {}}')
        with pytest.raises(ValueError, match="Answer"):
            until(executor, Flown)


def test_what_is_asked_of_slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "srun").touch(0o700)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    spec = SlurmSpec(folder=str(tmp_path), partition="cpu", minutes=30)
    jobs = batch_system(spec, tmp_path / "jobs")
    assert isinstance(jobs, submitit.SlurmExecutor)
    asked = jobs._make_submission_file_text("command", "id").splitlines()
    wanted = ("partition=cpu", "time=30", "mem=4GB", "cpus-per-task=1", "ntasks-per-node=1", "job-name=zenfi")
    assert {f"#SBATCH --{line}" for line in wanted} <= set(asked)


@pytest.mark.soak
def test_where_there_is_no_slurm_nothing_is_stored(tmp_path: Path) -> None:
    store, shared = tmp_path / "store", tmp_path / "shared"
    for folder, complaint in ((shared, b"No such file"), (tmp_path, b"no srun here")):
        at = f"slurm:{folder}"
        with durability.zenfi(store, "run", durability.spec(tmp_path), "--executor", at) as command:
            _, said = command.communicate(timeout=600)
            assert command.returncode == 2
        assert complaint in said
        assert len(said.splitlines()) == 1
    assert not (store / "zenfi.sqlite").exists()
    assert not list(tmp_path.glob("zenfi-*"))
