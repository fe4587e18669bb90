"""The worker processes of a Dask worker: they outlast threads and tasks, not their owner and not idleness."""

import threading
import time
from collections.abc import Iterator

import pytest

from deploy.workers import dask_task
from deploy.workers.client import WorkerClient
from tests.conftest import descendants, wait_until


@pytest.fixture
def idle_workers() -> Iterator[dask_task._IdleWorkers]:
    made = dask_task._IdleWorkers()
    yield made
    made._starter.shutdown()


def test_a_worker_outlasts_the_thread_that_asked_for_it_and_serves_the_next(
    idle_workers: dask_task._IdleWorkers,
) -> None:
    found: list[WorkerClient] = []
    started = threading.Event()

    def task() -> None:
        found.append(idle_workers.take())
        # It has a fork server, so it has asked to be killed with its parent by now.
        wait_until(lambda: bool(descendants(found[0].pid)) or not found[0].lives, 120.0)
        started.set()

    thread = threading.Thread(target=task)
    thread.start()
    thread.join()
    assert started.is_set()
    time.sleep(0.2)
    (worker,) = found
    assert worker.lives
    idle_workers.give_back(worker)
    assert idle_workers.take() is worker
    worker.end()


def test_a_worker_that_nothing_comes_for_is_ended(
    idle_workers: dask_task._IdleWorkers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask_task, "IDLE_S", 0.1)
    worker = idle_workers.take()
    idle_workers.give_back(worker)
    wait_until(lambda: not worker.lives)
    another = idle_workers.take()
    assert another is not worker
    another.end()
