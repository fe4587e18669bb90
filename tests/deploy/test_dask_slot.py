"""The worker processes of a Dask worker: they outlast threads and tasks, not their owner and not idleness."""

import threading
import time
from collections.abc import Iterator

import pytest

from deploy import dask_slot
from deploy.crew import Worker
from tests.conftest import descendants, wait_until


@pytest.fixture
def crew() -> Iterator[dask_slot._Crew]:
    made = dask_slot._Crew()
    yield made
    made._starter.shutdown()


def test_a_worker_outlasts_the_thread_that_asked_for_it_and_serves_the_next(crew: dask_slot._Crew) -> None:
    found: list[Worker] = []
    started = threading.Event()

    def task() -> None:
        found.append(crew.take())
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
    crew.give_back(worker)
    assert crew.take() is worker
    worker.end()


def test_a_worker_that_nothing_comes_for_is_ended(
    crew: dask_slot._Crew, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask_slot, "IDLE_S", 0.1)
    worker = crew.take()
    crew.give_back(worker)
    wait_until(lambda: not worker.lives)
    another = crew.take()
    assert another is not worker
    another.end()
