"""Runs on this machine's processors: a failure of ours is loud."""

import os
import subprocess
import sys
import time
from collections.abc import Callable

import pytest

from dashboard.campaigns.events import Lost, RunStarted
from dashboard.campaigns.executors import local
from dashboard.campaigns.executors.executor import ExecutorReport, ExecutorTask
from dashboard.campaigns.spec import Run
from dashboard.campaigns.state_machine import CampaignStates
from deploy.errors import InfrastructureError
from services.models.mission import MissionSpec
from tests.bench.fly_all import fly_all
from tests.dashboard.campaigns.executors.flights import LEASE_S, Outcomes, at_the_nth_beginning, flown
from tests.dashboard.campaigns.test_durability import fork_servers, kill_one_of, side_servers

RUN = Run("golden", 0, MissionSpec())


def worker(script: str) -> Callable[..., subprocess.Popen[bytes]]:
    def start(_: int, __: int | None, *, watched: bool) -> subprocess.Popen[bytes]:
        assert watched
        command = [sys.executable, "-c", script]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    return start


def test_a_worker_that_talks_nonsense_ends_the_campaign(monkeypatch: pytest.MonkeyPatch) -> None:
    script = "import sys\nfor line in sys.stdin: print('{\"outcome\": {}}', flush=True)"
    monkeypatch.setattr(local, "start_worker", worker(script))
    with pytest.raises(ValueError, match="Answer"):
        list(fly_all([RUN], 1))


def test_workers_that_only_die_end_the_campaign(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "start_worker", worker("raise SystemExit"))
    with pytest.raises(InfrastructureError, match="workers died"):
        list(fly_all([Run("golden", index, MissionSpec()) for index in range(8)], 1))


def test_a_run_whose_workers_die_is_given_up_after_its_attempts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "start_worker", worker("raise SystemExit"))
    (finished,) = fly_all([RUN], 1)
    assert finished.outcome is None
    assert "the worker died, 5 times" in finished.error


def test_an_error_of_ours_fails_the_run_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    script = 'import sys\nfor line in sys.stdin: print(\'{"error": "a bug"}\', flush=True)'
    monkeypatch.setattr(local, "start_worker", worker(script))
    (finished,) = fly_all([RUN], 1)
    assert finished.error == "a bug"


def test_a_disturbed_flight_is_flown_again_by_the_same_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    script = (
        "import sys\nfor line in sys.stdin:"
        ' print(\'{"error": "sim was ended from outside", "disturbed": true}\', flush=True)'
    )
    monkeypatch.setattr(local, "start_worker", worker(script))
    (finished,) = fly_all([RUN], 1)
    assert finished.error == "sim was ended from outside, 5 times"


def test_a_silent_worker_loses_its_lease_and_its_process(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []
    make = worker("import time\ntime.sleep(600)")

    def start(cpu: int, log: int | None, *, watched: bool) -> subprocess.Popen[bytes]:
        started.append(make(cpu, log, watched=watched))
        return started[-1]

    monkeypatch.setattr(local, "start_worker", start)
    executor = local.LocalExecutor(1, lease_s=60.0)
    try:
        assert executor.submit(ExecutorTask("a", [(0, MissionSpec())])) == [
            ExecutorReport(RunStarted("a", 0))
        ]
        assert executor.leases == {"a"}
        executor.drop("a")
        assert started[0].poll() is not None
        assert executor.idle == 1
        started[1].kill()
        deadline = time.monotonic() + 20
        executor.submit(ExecutorTask("b", [(1, MissionSpec())]))
        reports: list[ExecutorReport] = []
        while not reports and time.monotonic() < deadline:
            reports = executor.poll(0.1)
        assert reports == [ExecutorReport(Lost("b", "the worker died"))]
    finally:
        executor.close()
    assert all(process.poll() is not None for process in started)


@pytest.mark.parametrize("servers", [fork_servers, pytest.param(side_servers, marks=pytest.mark.soak)])
def test_a_lost_fork_server_is_a_lost_worker_and_costs_an_attempt(
    here: Outcomes, servers: Callable[[int], list[int]]
) -> None:
    """The worker lives on, and could fly nothing more: each of its runs would fail at once."""

    def kill(_: CampaignStates, __: int) -> None:
        kill_one_of(servers, os.getpid())

    outcomes, attempts = flown(local.LocalExecutor(1, LEASE_S), at_the_nth_beginning(3, kill))
    assert outcomes == here
    assert sorted(attempts) == [1] * (len(here) - 1) + [2]
