"""Killed at any point, a campaign goes on: one result a run, the same as if nothing had happened."""

import contextlib
import json
import os
import signal
import sqlite3
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.store.store import Store
from deploy.mission.fork_protocol import SIDE_SERVER
from tests.conftest import alive, descendants, folders, wait_until
from tests.dashboard.command import ZENFI
from tests.fixtures.postgresql import Server

SPEC = """
name = "hard"
runs = {runs}
worlds = ["sparse", "dense"]
mission = {{limits = {{mission_time_s = 0.6}}}}
limits = {{attempts = 20, disk_mb = {disk_mb}}}
arms = [{{name = "golden"}}, {{name = "flip", fault = {{target = "pid"}}}}]
"""
RUNS = 24
OF_A_FLIGHT = ("zenfi-", "proxy-")
"""How the names of its processes begin."""

SIGNALS = (signal.SIGKILL, signal.SIGSEGV, signal.SIGTERM)

SOON = 4
"""So many processes are ended as soon as there are any."""

EACH = 3
"""No more than so many for each run that is flown: on a loaded machine a flight is to end, too."""

PATIENCE_S = 300.0


def spec(folder: Path, runs: int = RUNS // 4, disk_mb: int = 1000) -> str:
    path = folder / "hard.toml"
    path.write_text(SPEC.format(runs=runs, disk_mb=disk_mb))
    return str(path)


def zenfi(store: Path | str, *arguments: str) -> "subprocess.Popen[bytes]":
    command = [ZENFI, "campaign", *arguments, "--store", str(store), "--json"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def records(store: Path) -> list[FlightRecord]:
    with closing(Store(store)) as opened:
        return list(opened.records(opened.find("1")))


def done(store: Path) -> int:
    """Results in the store, read without disturbing it."""
    path = store / "zenfi.sqlite"
    if not path.exists():
        return 0
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True, timeout=30)) as connection:
        try:
            return int(connection.execute("SELECT count(*) FROM results").fetchone()[0])
        except sqlite3.OperationalError:  # not made yet
            return 0


def workers(scheduler: int) -> list[int]:
    found = []
    for pid in descendants(scheduler):
        try:
            line = Path(f"/proc/{pid}/cmdline").read_bytes()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if b"deploy.workers.worker" in line:
            found.append(pid)
    return found


def fork_servers(scheduler: int) -> list[int]:
    """The processes of which a worker's nodes are forked, one a worker."""
    found: list[int] = []
    for worker in workers(scheduler):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            found += map(int, Path(f"/proc/{worker}/task/{worker}/children").read_text().split())
    return found


def side_servers(scheduler: int) -> list[int]:
    """Those of which sidecars are forked."""
    return [pid for pid, name in descendants(scheduler).items() if name == SIDE_SERVER]


def kill_one_of(servers: Callable[[int], list[int]], scheduler: int) -> None:
    """Kill one, once there is one: a new worker has none yet."""
    wait_until(lambda: bool(servers(scheduler)), PATIENCE_S)
    kill(servers(scheduler)[0])


def kill(pid: int) -> None:
    if alive(pid):
        os.kill(pid, signal.SIGKILL)


def until(store: Path, results: int, command: "subprocess.Popen[bytes]") -> None:
    """Wait until so many runs are flown."""
    deadline = time.monotonic() + PATIENCE_S
    while done(store) < results and command.poll() is None:
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.1)


@pytest.mark.soak
@pytest.mark.parametrize(
    ("runs", "worker_at", "command_at", "resumed_at"),
    [(12, 2, 4, (6,)), (RUNS, 3, 6, (10, 14))],
)
def test_kills_change_nothing_but_the_time_it_takes(
    tmp_path: Path, runs: int, worker_at: int, command_at: int, resumed_at: tuple[int, ...]
) -> None:
    calm, hard = tmp_path / "calm", tmp_path / "hard"
    with zenfi(calm, "run", spec(tmp_path, runs // 4)) as command:
        assert command.wait(PATIENCE_S) == 0

    with zenfi(hard, "run", spec(tmp_path, runs // 4)) as command:
        until(hard, worker_at, command)
        kill(workers(command.pid)[0])
        until(hard, command_at, command)
        family = descendants(command.pid)
        kill(command.pid)
    wait_until(lambda: not any(map(alive, family)))
    for target in resumed_at:
        before = done(hard)
        with zenfi(hard, "resume", "hard-1") as command:
            until(hard, target, command)
            for worker in workers(command.pid):
                kill(worker)
            until(hard, target + 2, command)
            kill(command.pid)
        assert done(hard) > before
    with zenfi(hard, "resume") as command:
        assert command.wait(PATIENCE_S) == 0

    ours, theirs = records(hard), records(calm)
    assert [record.phase for record in ours] == ["done"] * runs
    assert [told(record) for record in ours] == [told(record) for record in theirs]


LOSSES = ((2, fork_servers), (5, side_servers), (8, fork_servers), (11, side_servers))


@pytest.mark.soak
@pytest.mark.parametrize(("runs", "losses"), [(12, LOSSES[:2]), (RUNS, LOSSES)], ids=[12, RUNS])
def test_a_lost_fork_server_costs_no_run(
    tmp_path: Path, runs: int, losses: Sequence[tuple[int, Callable[[int], list[int]]]]
) -> None:
    calm, hard = tmp_path / "calm", tmp_path / "hard"
    with zenfi(calm, "run", spec(tmp_path, runs // 4)) as command:
        assert command.wait(PATIENCE_S) == 0

    family: dict[int, str] = {}
    with zenfi(hard, "run", spec(tmp_path, runs // 4)) as command:
        for results, servers in losses:
            until(hard, results, command)
            family |= descendants(command.pid)
            kill_one_of(servers, command.pid)
        _, said = command.communicate(timeout=PATIENCE_S)
        assert command.returncode == 0, said

    ours, theirs = records(hard), records(calm)
    assert [(record.phase, record.error) for record in ours] == [("done", "")] * runs
    assert [told(record) for record in ours] == [told(record) for record in theirs]
    wait_until(lambda: not any(map(alive, family)))
    assert not [folder for pid in family for folder in folders(pid)]


@pytest.mark.soak
@pytest.mark.parametrize("runs", [4, 300])
def test_flights_whose_processes_are_ended_from_outside_are_flown_again(tmp_path: Path, runs: int) -> None:
    """Nodes, their proxies and injectors, at moments drawn by chance; the first few soon."""
    calm, hard = tmp_path / "calm", tmp_path / "hard"
    with zenfi(calm, "run", spec(tmp_path, runs // 4)) as command:
        assert command.wait(PATIENCE_S) == 0

    draw, kills = np.random.default_rng(runs), 0
    with zenfi(hard, "run", spec(tmp_path, runs // 4)) as command:
        while command.poll() is None:
            victims = [pid for pid, name in descendants(command.pid).items() if name.startswith(OF_A_FLIGHT)]
            due = kills < SOON + EACH * done(hard)
            if due and victims and alive(pid := victims[draw.integers(len(victims))]):
                os.kill(pid, SIGNALS[draw.integers(len(SIGNALS))])
                kills += 1
            time.sleep(draw.uniform(0.2, 1.2) if kills >= SOON else 0.1)
        _, said = command.communicate(timeout=PATIENCE_S)
        assert command.returncode == 0, said

    ours, theirs = records(hard), records(calm)
    assert [(record.phase, record.error) for record in ours] == [("done", "")] * runs
    assert [told(record) for record in ours] == [told(record) for record in theirs]
    assert sum(record.attempts for record in ours) > runs


def told(record: FlightRecord) -> tuple[object, ...]:
    """What must not depend on who flew a run, and when. A fault's instant is drawn in thread time."""
    result = record.result
    assert result is not None
    twin = (result.twin_result, result.twin_flight_time_s, result.twin_energy_kj)
    flown = (result.result, result.digest, result.flight_time_s, result.distance_m, result.energy_kj)
    return (record.cell, record.number, record.seed, *(twin if result.injection else flown))


@pytest.mark.soak
def test_ctrl_c_pauses_and_says_how_to_go_on(tmp_path: Path) -> None:
    store = tmp_path / "store"
    with zenfi(store, "run", spec(tmp_path)) as command:
        until(store, 1, command)
        command.send_signal(signal.SIGINT)
        _, said = command.communicate(timeout=600)
        assert command.returncode == 130
    assert b"zenfi campaign resume hard-1" in said
    assert {record.phase for record in records(store)} == {"done", "queued"}
    with closing(Store(store)) as opened:
        found = opened.find("hard-1")
        assert (found.phase, found.reason) == ("paused", "interrupted")


@pytest.mark.soak
def test_a_full_store_pauses_the_campaign_and_loses_nothing(tmp_path: Path) -> None:
    store = tmp_path / "store"
    with zenfi(store, "run", spec(tmp_path, runs=2, disk_mb=1)) as command:
        until(store, 1, command)
        fill(store)
        _, said = command.communicate(timeout=PATIENCE_S)
        assert command.returncode == 1
    (line,) = [line for line in said.decode().splitlines() if line.startswith("zenfi:")]
    assert "full" in line
    assert "zenfi campaign resume hard-1" in line
    kept = done(store)
    assert kept >= 1
    assert all((record.phase == "done") == (record.result is not None) for record in records(store))
    with zenfi(store, "resume", "--disk-mb", "100") as command:
        assert command.wait(PATIENCE_S) == 0
    assert [record.phase for record in records(store)] == ["done"] * 8


@pytest.mark.soak
def test_on_postgresql_a_campaign_is_killed_and_paused_and_goes_on(
    tmp_path: Path, postgresql_server: Server
) -> None:
    where = postgresql_server.database()
    with closing(Store(where)) as store:

        def flown() -> int:
            return store.progress(store.find("1"))["done"] if store.campaigns() else 0

        with zenfi(where, "run", spec(tmp_path, runs=3)) as command:
            wait_until(lambda: flown() > 0, PATIENCE_S)
            kill(command.pid)
        wait_until(lambda: not store.is_flying(store.find("1")))
        left = flown()
        assert store.find("1").phase == "running"
        subprocess.run([ZENFI, "campaign", "pause", "hard-1", "--store", where], check=True)
        assert store.find("1").phase == "paused"
        with zenfi(where, "resume") as command:
            wait_until(lambda: flown() > left, PATIENCE_S)
            store.set_desired_state(store.find("1"), "pause")
            assert command.wait(PATIENCE_S) == 1
        assert (store.find("1").phase, store.find("1").reason) == ("paused", "paused")
        with zenfi(where, "resume") as command:
            _, said = command.communicate(timeout=PATIENCE_S)
            assert command.returncode == 0, said
        assert [one.phase for one in store.records(store.find("1"))] == ["done"] * 12


def fill(store: Path) -> None:
    with closing(sqlite3.connect(store / "zenfi.sqlite", timeout=30)) as connection:
        connection.execute("CREATE TABLE ballast AS SELECT zeroblob(1200000) AS weight")
        connection.commit()


@pytest.mark.soak
def test_a_campaign_that_is_flown_can_be_cancelled_from_outside(tmp_path: Path) -> None:
    store = tmp_path / "store"
    # More than are flown until the two commands below have started on a busy machine.
    with zenfi(store, "run", spec(tmp_path, 500)) as command:
        until(store, 1, command)
        listed = subprocess.run(
            [ZENFI, "campaign", "list", "--store", str(store), "--json"], capture_output=True, check=True
        )
        assert json.loads(listed.stdout)["phase"] == "running"
        subprocess.run([ZENFI, "campaign", "cancel", "hard-1", "--store", str(store)], check=True)
        assert command.wait(PATIENCE_S) == 1
    assert {record.phase for record in records(store)} == {"done", "cancelled"}
