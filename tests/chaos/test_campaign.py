"""Whatever befalls what flies a campaign: equal, or shown as not flown; nothing lost, nothing left over."""

import os
from pathlib import Path

import pytest

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.spec import Cell
from tests.chaos.campaign import fly_under_chaos, specification, undisturbed, verdict
from tests.chaos.deployment import StoreKind
from tests.chaos.processes import class_of
from tests.dashboard.campaigns.store.test_store import outcome
from tests.fixtures import postgresql

RUNS = 18
OF_ROOT = "mounts a disk, which is root's alone"


@pytest.mark.soak
@pytest.mark.parametrize(
    ("kind", "dask", "seed"),
    [("sqlite", False, 1), ("postgresql", False, 2), ("sqlite", True, 3)],
    ids=["sqlite", "postgresql", "dask"],
)
def test_a_campaign_under_chaos(tmp_path: Path, kind: StoreKind, dask: bool, seed: int) -> None:
    if os.geteuid():
        pytest.skip(OF_ROOT)
    if kind == "postgresql" and postgresql.binaries() is None:
        pytest.skip("no PostgreSQL server here: apt-get install postgresql")
    spec = specification(RUNS, recorded=not dask)
    report = fly_under_chaos(spec, undisturbed(spec, tmp_path), seed, kind, dask=dask, tell=print)
    assert len(report.disturbances) >= RUNS // 4
    assert (report.differences, report.left) == ([], [])
    assert report.count("equal") + report.count("not flown") == RUNS
    assert report.count("equal") >= RUNS // 2


def record(phase: str = "done", error: str = "", digest: str = "d") -> FlightRecord:
    result = Result.of(outcome(digest)) if phase == "done" else None
    return FlightRecord(Cell("a", "sparse", ""), 0, 0, phase, 1, error, result, 1)


@pytest.mark.parametrize(
    ("hard", "expected"),
    [
        (record(), "equal"),
        (record(digest="other"), "differing"),
        (record("failed", "it was disturbed, 5 times"), "not flown"),
        (record("failed"), "lost"),
        (record("queued"), "lost"),
        (None, "lost"),
    ],
)
def test_what_becomes_of_a_run_is_told(hard: FlightRecord | None, expected: str) -> None:
    assert verdict(record(), hard) == expected


@pytest.mark.parametrize(
    ("expected", "name", "line", "parent"),
    [
        ("node", "zenfi-perceptio", "python -m deploy.workers.worker", "proxy"),
        ("injector", "zenfi-injector", "python", "reaper"),
        ("proxy", "proxy-planning", "python", "fork server"),
        ("reaper", "proxy-injector", "python", "fork server"),
        ("fork server", "python", "python bootstrap", "worker"),
        ("fork server", "fork-sidecars", "python bootstrap", "fork server"),
        ("worker", "python", "python -P -m deploy.workers.worker 0", "campaign process"),
        ("service", "python", "python -m dashboard serve", ""),
        ("PostgreSQL server", "postgres", "/usr/lib/bin/postgres -D data", ""),
        ("Dask worker", "python", "python -m distributed.cli.dask_worker tcp://127.0.0.1:1", ""),
        ("", "cat", "cat", "service"),
    ],
)
def test_processes_have_their_class(expected: str, name: str, line: str, parent: str) -> None:
    assert class_of(name, line.split(), parent) == expected


def test_sessions_of_a_database_server_are_told_by_whose_they_are() -> None:
    for whose, expected in (("zenfi test [local] idle", "PostgreSQL session"), ("checkpointer", "")):
        assert class_of("postgres", [f"postgres: {whose}"], "PostgreSQL server") == expected
