"""Real flights on a Dask cluster of this machine: two workers, a slot each."""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import dask.config
import pytest
from click.testing import CliRunner
from distributed import Client, LocalCluster

from dashboard.campaigns.events import Flown, Lost, RunStarted
from dashboard.campaigns.executors import choice
from dashboard.campaigns.executors.dask import DaskExecutor
from dashboard.campaigns.executors.executor import ExecutorTask
from dashboard.campaigns.executors.spec import DaskSpec
from dashboard.campaigns.spec import Run
from dashboard.campaigns.state_machine import CampaignStates
from dashboard.cli import zenfi
from deploy.errors import BadSpecError, InfrastructureError
from deploy.workers import installation
from deploy.workers.dask_task import RESOURCE, SlotMessage
from services.models.faults.specification import FaultSpec
from tests.conftest import alive, descendants, wait_until
from tests.dashboard.campaigns import test_durability as durability
from tests.dashboard.campaigns.executors.flights import (
    LEASE_S,
    SHORT,
    Outcomes,
    at_the_nth_beginning,
    flown,
    nodes,
    scheduler_of,
)

PATIENCE_S = 120.0
FOR_LONG = [(number, SHORT.model_copy(update={"seed": number})) for number in range(300)]


def a_cluster(workers: int = 2, **options: object) -> LocalCluster:
    return LocalCluster(
        n_workers=workers,
        **{"threads_per_worker": 1, "resources": {RESOURCE: 1}, **options},
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    )


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    with a_cluster() as made:
        yield made.scheduler_address


def test_the_same_outcomes_as_on_this_machine(cluster: str, here: Outcomes) -> None:
    outcomes, attempts = flown(DaskExecutor(cluster, None, LEASE_S))
    assert outcomes == here
    assert set(attempts) == {1}


@pytest.mark.soak
def test_a_worker_killed_while_it_flies_costs_one_attempt(here: Outcomes) -> None:
    killed: list[int] = []
    family: dict[int, str] = {}
    with a_cluster() as made, Client(made, set_as_default=False) as client:

        def kill(states: CampaignStates, run: int) -> None:
            lease = states.runs[run].lease
            (host,) = (
                name
                for name, keys in client.processing().items()
                if any(key.endswith(f"-{lease}") for key in keys)
            )
            pid = client.run(os.getpid, workers=[host])[host]
            wait_until(lambda: bool(nodes(pid)), PATIENCE_S)
            family.update(descendants(pid))
            os.kill(pid, signal.SIGKILL)
            killed.append(run)

        executor = DaskExecutor(made.scheduler_address, None, LEASE_S)
        outcomes, attempts = flown(executor, at_the_nth_beginning(3, kill))
        assert outcomes == here
        assert killed
        # The run that was under way by then: that one, or one after it.
        assert sorted(attempts) == [1] * (len(here) - 1) + [2]
        wait_until(lambda: not any(map(alive, family)))


@pytest.mark.soak
def test_a_scheduler_that_is_killed_leaves_no_flight_behind_and_is_resumed(
    cluster: str, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    path = durability.spec(tmp_path, 2)
    with durability.zenfi(store, "run", path, "--executor", cluster.replace("tcp", "dask")) as command:
        durability.until(store, 2, command)
        os.kill(command.pid, signal.SIGKILL)
    wait_until(lambda: not nodes(), PATIENCE_S / 2)
    assert durability.done(store) < 8
    with durability.zenfi(store, "resume") as command:
        assert command.wait(durability.PATIENCE_S) == 0
    assert [record.phase for record in durability.records(store)] == ["done"] * 8


def test_paused_and_cancelled_work_ends(cluster: str) -> None:
    with closing(DaskExecutor(cluster, None, LEASE_S)) as executor:
        scheduler = scheduler_of(executor)
        flights = scheduler.fly()
        next(flights)
        threading.Thread(target=scheduler.stop, args=["enough"]).start()
        list(flights)
        assert (scheduler.states.phase, scheduler.states.reason) == ("paused", "enough")
        assert not scheduler.states.count("leased", "running")
    wait_until(lambda: not nodes(), PATIENCE_S / 2)


def test_dropped_tasks_end_and_those_of_a_scheduler_that_leaves(cluster: str) -> None:
    with closing(DaskExecutor(cluster, None, LEASE_S)) as executor:
        idle = executor.idle
        executor.submit(ExecutorTask("a", FOR_LONG))
        until(executor, RunStarted("a", 0))
        wait_until(lambda: bool(nodes()), PATIENCE_S)
        executor.drop("a")
        assert executor.idle == idle
        wait_until(lambda: not nodes(), PATIENCE_S / 2)
        executor.submit(ExecutorTask("b", FOR_LONG))
        until(executor, RunStarted("b", 0))
        wait_until(lambda: bool(nodes()), PATIENCE_S)
    wait_until(lambda: not nodes(), PATIENCE_S / 2)


def test_no_worker_is_missed_while_dask_notes_the_cluster_in_another_thread(cluster: str) -> None:
    often = dask.config.set({"distributed.client.scheduler-info-interval": "1ms"})
    with often, closing(DaskExecutor(cluster, None, LEASE_S)) as executor:
        for _ in range(200):
            executor._look()
            assert executor.slots == 2


def test_a_task_that_dask_begins_again_by_itself_is_lost(cluster: str) -> None:
    with closing(DaskExecutor(cluster, None, LEASE_S)) as executor:
        executor.submit(ExecutorTask("a", FOR_LONG))
        until(executor, RunStarted("a", 0))
        (key,) = executor._flights
        again = SlotMessage(task=key, execution="another", kind="begun", run=0)
        executor._hear((0.0, again.model_dump_json()))
        until(executor, Lost("a", "the worker was started again"))
        assert not executor.leases
    wait_until(lambda: not nodes(), PATIENCE_S / 2)


def until(executor: DaskExecutor, event: RunStarted | Lost) -> None:
    """Poll until something is reported."""
    deadline = time.monotonic() + PATIENCE_S
    while all(report.event != event for report in executor.poll(1.0)):
        assert time.monotonic() < deadline, "it did not happen"


@pytest.mark.soak
def test_an_error_of_ours_is_not_tried_again(cluster: str) -> None:
    impossible = SHORT.model_copy(update={"fault": FaultSpec(target="lawn_mower")})
    with closing(DaskExecutor(cluster, None, LEASE_S)) as executor:
        scheduler = scheduler_of(executor, {0: Run("x", 0, impossible)})
        (finished,) = scheduler.fly()
    assert "never runs lawn_mower" in finished.error
    assert scheduler.states.runs[0].attempts == 1


@pytest.mark.soak
def test_a_worker_never_flies_more_than_it_has_slots() -> None:
    with a_cluster(1, threads_per_worker=4) as made:
        with (
            closing(DaskExecutor(made.scheduler_address, None, LEASE_S)) as one,
            closing(DaskExecutor(made.scheduler_address, None, LEASE_S)) as other,
        ):
            at_once, left = 0, {"one", "other"}
            one.submit(ExecutorTask("one", [(0, SHORT)]))
            other.submit(ExecutorTask("other", [(0, SHORT)]))
            while left:
                for executor in (one, other):
                    events = [report.event for report in executor.poll(0.05)]
                    left -= {event.lease for event in events if isinstance(event, Flown)}
                names = descendants(os.getpid()).values()
                at_once = max(at_once, sum(name == "zenfi-sim" for name in names))
        assert at_once == 1


@pytest.mark.soak
def test_a_cluster_that_goes_away_pauses_the_campaign() -> None:
    made = a_cluster(1)
    executor = DaskExecutor(made.scheduler_address, None, LEASE_S)
    with closing(executor):
        flights = scheduler_of(executor).fly()
        next(flights)
        made.close()
        with pytest.raises(InfrastructureError, match="is gone"):
            list(flights)


# -- refusals ------------------------------------------------------------------------------------------


def test_an_address_where_nobody_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dashboard.campaigns.executors.dask.CONNECT_S", 1.0)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(BadSpecError, match=f"no Dask scheduler answers at {address}"):
            DaskExecutor(address, None, LEASE_S)


def test_a_cluster_without_slots_is_refused_with_nothing_stored(tmp_path: Path) -> None:
    with a_cluster(1, resources={}) as made:
        store = tmp_path / "store"
        at = made.scheduler_address.replace("tcp", "dask")
        with durability.zenfi(store, "run", durability.spec(tmp_path), "--executor", at) as command:
            _, said = command.communicate(timeout=600)
            assert command.returncode == 2
    lines = said.decode().splitlines()
    assert len(lines) == 1, lines
    assert "has the resource zenfi_slot" in lines[0]
    assert "--resources zenfi_slot=1" in lines[0]
    assert not (store / "zenfi.sqlite").exists()


def test_a_worker_of_another_version_is_refused(cluster: str, monkeypatch: pytest.MonkeyPatch) -> None:
    newer = installation.own().model_copy(update={"zenfi": "9.9"})
    monkeypatch.setattr(installation, "own", lambda: newer)
    with pytest.raises(BadSpecError, match=r"worker tcp://.* zenfi is .* there, 9\.9 here"):
        DaskExecutor(cluster, None, LEASE_S)


def test_a_worker_that_comes_later_refuses_by_itself(cluster: str, monkeypatch: pytest.MonkeyPatch) -> None:
    newer = installation.own().model_copy(update={"forms": "other"})
    monkeypatch.setattr(installation, "told", newer.model_dump_json)
    monkeypatch.setattr(DaskExecutor, "_refuse_strangers", lambda _: None)
    with (
        closing(DaskExecutor(cluster, None, LEASE_S)) as executor,
        pytest.raises(InfrastructureError, match="the form of specification and outcome"),
    ):
        list(scheduler_of(executor).fly())


def test_without_dask_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "dashboard.campaigns.executors.dask")
    with pytest.raises(BadSpecError, match=r"pip install 'zenfi\[dask\]'"):
        choice.open_executor(DaskSpec(address="tcp://127.0.0.1:8786"), None, LEASE_S, None)


@pytest.mark.parametrize("text", ["dask", "slurm", "dask://", "dask://host", "http://host:1", "slurm:shared"])
def test_a_malformed_executor(tmp_path: Path, text: str) -> None:
    arguments = ["campaign", "run", durability.spec(tmp_path), "--executor", text]
    error = CliRunner().invoke(zenfi, arguments).exception
    assert isinstance(error, BadSpecError)
    assert f"--executor {text}" in str(error)
