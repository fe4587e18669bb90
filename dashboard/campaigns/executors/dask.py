"""The Dask executor: a cluster that is there already, a resource for each mission slot.

Every lease is one Dask task, held to a worker of our choice, so that Dask never flies it again elsewhere
by itself: what is lost goes back to the scheduler, which counts attempts. What slots tell comes as
events; a task's own result is nothing.
"""

from __future__ import annotations

import contextlib
import queue
import time
import uuid
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from distributed import Client, Future, KilledWorker

from dashboard.campaigns.events import Alive, Lost, RunStarted
from dashboard.campaigns.executors.executor import ExecutorReport, ExecutorTask, Losses, reports, unrecorded
from deploy.errors import BadSpecError, InfrastructureError
from deploy.workers import dask_task, installation
from deploy.workers.protocol import WorkerAnswer

CONNECT_S = 10.0
LOOK_S = 1.0
"""Between two looks at who belongs to the cluster."""


@dataclass(slots=True)
class _Flight:
    """A lease and the task that flies it."""

    lease: str
    host: str
    future: Future[None]
    todo: set[int]
    execution: str = field(default="")


class DaskExecutor:
    """Slots of a Dask cluster, at most ``slots`` of them (default: all).

    :raises BadSpecError: if the cluster cannot be reached, has no slot, or flies another zenfi.
    """

    fill = 1

    def __init__(self, address: str, slots: int | None, lease_s: float) -> None:
        self._address = address
        self._limit = slots
        self._lease_s = lease_s
        self._session = uuid.uuid4().hex
        self._identity = installation.told()
        self._inbox: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._flights: dict[str, _Flight] = {}
        self._hosts: dict[str, int] = {}
        self._heard: dict[str, tuple[float, float]] = {}
        self._losses = Losses()
        self._client = _connected(address)
        try:
            self._look_round()
            self._client.subscribe_topic(dask_task.TOPIC, self._hear)
            self._refuse_strangers()
        except BaseException:
            self.close()
            raise

    @property
    def slots(self) -> int:
        """Flights at a time, as the cluster is now."""
        count = sum(self._hosts.values())
        return min(count, self._limit) if self._limit else count

    @property
    def leases(self) -> set[str]:
        """The leases of the tasks that workers have now."""
        return {flight.lease for flight in self._flights.values()}

    @property
    def idle(self) -> int:
        """Free slots, and one task per worker that waits there, so that no slot waits for us in between."""
        all_ours = self._limit is None or self._limit >= sum(self._hosts.values())
        return max(0, self.slots + all_ours * len(self._hosts) - len(self._flights))

    def submit(self, task: ExecutorTask) -> list[ExecutorReport]:
        """Give a task to the worker with most free slots; it begins when its slot does."""
        held = Counter(flight.host for flight in self._flights.values())
        host = max(self._hosts, key=lambda name: self._hosts[name] - held[name])
        key = f"zenfi-{self._session}-{task.lease}"
        runs = [(run, order.model_dump_json()) for run, order in task.orders(unrecorded)]
        with self._within_reach():
            future = self._client.submit(
                dask_task.fly,
                key,
                runs,
                self._identity,
                key=key,
                workers=[host],
                resources={dask_task.RESOURCE: 1},
                retries=0,
                pure=False,
            )
        self._flights[key] = _Flight(task.lease, host, future, {run for run, _ in task.runs})
        return []

    def drop(self, lease: str) -> None:
        """Cancel the task; its slot kills what it flies as soon as it hears of that."""
        for key, flight in list(self._flights.items()):
            if flight.lease == lease:
                self._forget(key)

    def poll(self, timeout_s: float) -> list[ExecutorReport]:
        """What slots have told since the last call, waiting for the first for ``timeout_s``."""
        told: list[ExecutorReport] = []
        with contextlib.suppress(queue.Empty):
            message = self._inbox.get(timeout=timeout_s)
            while True:
                told += self._told(message)
                message = self._inbox.get_nowait()
        if time.monotonic() >= self._looked_s + LOOK_S:
            told += self._look()
        return told

    def close(self) -> None:
        """Cancel every task and leave the cluster."""
        with contextlib.suppress(Exception):  # it may be gone
            self._client.cancel([flight.future for flight in self._flights.values()])
        self._flights.clear()
        self._client.close()

    # -- what slots tell ---------------------------------------------------------------------------

    def _hear(self, event: tuple[float, str]) -> None:
        """Called by Dask in its own thread; other campaigns' messages come as well."""
        if self._session in event[1]:
            self._inbox.put(event[1])

    def _told(self, line: str) -> list[ExecutorReport]:
        message = dask_task.SlotMessage.model_validate_json(line)
        flight = self._flights.get(message.task)
        if flight is None:
            return []
        flight.execution = flight.execution or message.execution
        if message.execution != flight.execution:
            return self._lost(message.task, "the worker was started again")
        match message.kind:
            case "refused":
                raise InfrastructureError(_stranger(flight.host, message.text))
            case "died":
                self._losses.another()
                return self._lost(message.task, message.text)
            case "begun":
                return [ExecutorReport(RunStarted(flight.lease, message.run))]
        answer = WorkerAnswer.model_validate_json(message.text)
        if not answer.alive:
            self._losses.none()
            flight.todo.discard(message.run)
            if not flight.todo:
                del self._flights[message.task]
        return reports(flight.lease, message.run, answer, self._lease_s)

    def _lost(self, key: str, why: str) -> list[ExecutorReport]:
        return [ExecutorReport(Lost(self._forget(key), why))]

    def _forget(self, key: str) -> str:
        flight = self._flights.pop(key)
        with self._within_reach():
            flight.future.cancel()
        return flight.lease

    # -- the cluster -------------------------------------------------------------------------------

    def _look(self) -> list[ExecutorReport]:
        """Who has left; and that what waits for a slot of a living worker is not forgotten."""
        self._look_round()
        now = time.monotonic()
        if now > self._manned_s + self._lease_s:
            message = f"no worker with the resource {dask_task.RESOURCE} is left at {self._address}"
            raise InfrastructureError(message)
        told: list[ExecutorReport] = []
        for _ in {flight.host for flight in self._flights.values()} - self._hosts.keys():
            self._losses.another()
        for key, flight in list(self._flights.items()):
            if flight.host not in self._hosts:
                told += self._lost(key, "the worker left the cluster")
            elif flight.future.status == "error":
                told += self._failed(key, flight)
            elif not flight.execution:
                told.append(ExecutorReport(Alive(flight.lease, now + self._lease_s)))
        return told

    def _failed(self, key: str, flight: _Flight) -> list[ExecutorReport]:
        error = flight.future.exception(timeout=CONNECT_S)
        if isinstance(error, KilledWorker):
            return self._lost(key, "the worker died")
        message = f"worker {flight.host}: {type(error).__name__}: {error}"
        raise InfrastructureError(message)

    def _look_round(self) -> None:
        """Take note of the workers with slots that Dask has heard of lately."""
        with self._within_reach():
            scheduler = self._client.scheduler
            if scheduler is None:  # the client has given up meanwhile, in its own thread
                raise ConnectionError("the client has closed")
            # Not Client.scheduler_info: its answer is a dict that the same thread replaces at any time, by
            # one without workers.
            workers = self._client.sync(scheduler.identity, n_workers=-1)["workers"]
        now = self._looked_s = time.monotonic()
        self._hosts = {}
        for name, facts in workers.items():
            slots = int(facts["resources"].get(dask_task.RESOURCE, 0))
            seen, changed_s = self._heard.get(name, (0.0, now))
            if seen != facts["last_seen"]:
                changed_s = now
            self._heard[name] = (facts["last_seen"], changed_s)
            if slots and now < changed_s + self._lease_s:
                self._hosts[name] = slots
        if self._hosts:
            self._manned_s = now

    def _refuse_strangers(self) -> None:
        if not self._hosts:
            message = (
                f"no worker at {self._address} has the resource {dask_task.RESOURCE}: "
                f"start them with dask worker {self._address} --resources {dask_task.RESOURCE}=1"
            )
            raise BadSpecError(message)
        own = installation.own()
        told = self._client.run(installation.told, workers=list(self._hosts), on_error="return")
        for host, answer in told.items():
            if isinstance(answer, Exception):
                raise BadSpecError(_stranger(host, f"{type(answer).__name__}: {answer}"))
            difference = own.difference(installation.Installation.model_validate_json(answer))
            if difference:
                raise BadSpecError(_stranger(host, difference))

    @contextlib.contextmanager
    def _within_reach(self) -> Iterator[None]:
        """What Dask cannot do without its scheduler, as an error of ours."""
        gone = f"the Dask scheduler at {self._address} is gone"
        if self._client.status != "running":
            raise InfrastructureError(gone)
        try:
            yield
        except (OSError, RuntimeError) as error:
            message = f"{gone}: {error}"
            raise InfrastructureError(message) from error


def _stranger(host: str, what: str) -> str:
    return f"worker {host} flies another zenfi: {what}; install the same version everywhere"


def _connected(address: str) -> Client:
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False, name="zenfi")
    except (OSError, ValueError, TypeError) as error:
        message = f"no Dask scheduler answers at {address}: {str(error).splitlines()[0]}"
        raise BadSpecError(message) from error
