"""What flies a campaign: a service, its database, a Dask cluster; restarted as an init system would."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import httpx
import sqlalchemy as sa

from deploy.workers.dask_task import RESOURCE
from services.system.lifeline import die_with_parent
from tests.dashboard.command import ZENFI
from tests.fixtures import postgresql

PATIENCE_S = 300.0
DASK_WORKERS = 4
AGAIN_S = 2.0
"""From the end of a process to its next life."""

UNREADY_S = 60.0
"""After so long without a good answer the service is started again, as a liveness probe has it."""

StoreKind = Literal["sqlite", "postgresql"]


@dataclass
class Daemon:
    """A process that is started again whenever it has ended."""

    command: Sequence[str]
    environment: Mapping[str, str]
    log: Path
    folder: Path
    process: subprocess.Popen[bytes] | None = None
    ended_s: float = 0.0
    starts: int = 0

    def keep_up(self) -> None:
        """Start it, if it does not run."""
        if self.process is not None and self.process.poll() is not None:
            self.process, self.ended_s = None, time.monotonic()
        if self.process is None and time.monotonic() >= self.ended_s + AGAIN_S:
            self.starts += 1
            with self.log.open("ab") as log:
                self.process = subprocess.Popen(
                    self.command,
                    stdout=log,
                    stderr=log,
                    cwd=self.folder,
                    env=dict(self.environment),
                    preexec_fn=die_with_parent,  # noqa: PLW1509 - one system call
                )

    def end(self, number: signal.Signals = signal.SIGTERM) -> None:
        """Tell it to end, and wait."""
        if self.process is not None:
            self.process.send_signal(number)
            self.process.wait(PATIENCE_S)
            self.process = None


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@dataclass
class Standing:
    """How the campaign stands, as its store has it."""

    phase: str = ""
    reason: str = ""
    wish: str = ""
    running: frozenset[int] = frozenset()
    ended: frozenset[int] = frozenset()


@dataclass
class Deployment:
    """What flies: the service at ``address``, or the command on the Dask cluster at ``cluster``.

    The store is at ``where``, for who only reads at ``readable``, its files are in ``store``.
    """

    where: str
    store: Path
    readable: sa.URL
    home: Path
    address: str
    cluster: str
    daemons: dict[str, Daemon] = field(default_factory=dict)
    resumed: Counter[str] = field(default_factory=Counter)
    _well_s: float = field(default_factory=time.monotonic)
    _asked_s: float = 0.0

    @property
    def own(self) -> list[int]:
        """The pids of the processes that this one has started itself."""
        return [one.process.pid for one in self.daemons.values() if one.process is not None]

    def keep_up(self) -> None:
        """Start again what has ended."""
        for daemon in self.daemons.values():
            daemon.keep_up()

    def request(self, method: str, path: str, **what: object) -> httpx.Response | None:
        """The service's answer, None if there is none."""
        try:
            return httpx.request(method, f"{self.address}{path}", timeout=5.0, **what)  # type: ignore[arg-type]
        except httpx.TransportError:
            return None

    def look(self, engine: sa.Engine, last: Standing) -> Standing:
        """How the first campaign stands; as it did, if the store cannot be read now."""
        try:
            with engine.connect() as connection:
                campaign = connection.execute(_CAMPAIGN).one_or_none()
                runs = connection.execute(_RUNS).all()
        except (sa.exc.SQLAlchemyError, OSError):
            return last
        if campaign is None:
            return last
        of = {phase: frozenset(run for run, found in runs if found == phase) for _, phase in runs}
        ended = of.get("done", frozenset()) | of.get("failed", frozenset())
        phase, reason, wish = map(str, campaign)
        return Standing(phase, reason, wish, of.get("running", frozenset()), ended)

    def operate(self, label: str, standing: Standing, *, disturbed: bool) -> None:
        """Do what an operator does: resume what has paused, start a service again that stays unready."""
        now = time.monotonic()
        if now < self._asked_s + 5.0 or "service" not in self.daemons:
            return
        self._asked_s = now
        ready = self.request("GET", "/ready")
        if disturbed or (ready is not None and ready.is_success):
            self._well_s = now
        elif now > self._well_s + UNREADY_S:
            self.resumed["the service was not ready: started again"] += 1
            self._well_s = now
            self.daemons["service"].end(signal.SIGKILL)
            return
        state = self.request("GET", "/api/v1/state")
        given_up = state.json()["given_up"] if state is not None and state.is_success else {}
        paused = standing.phase == "paused" and standing.wish == ""
        if not disturbed and (paused or label in given_up):
            answer = self.request("POST", f"/api/v1/campaigns/{label}/resume")
            if answer is not None and answer.is_success:
                self.resumed[given_up.get(label) or standing.reason] += 1

    def close(self) -> None:
        """End all, who uses others first."""
        for daemon in self.daemons.values():
            daemon.end()


_CAMPAIGN = sa.text("SELECT phase, reason, wish FROM campaigns ORDER BY id LIMIT 1")
_RUNS = sa.text("SELECT id, phase FROM runs WHERE campaign_id = (SELECT min(id) FROM campaigns)")


def _sqlite(folder: Path) -> sa.URL:
    return sa.make_url(f"sqlite:///file:{folder}/zenfi.sqlite?mode=ro&uri=true")


def _postgresql(folder: Path) -> sa.URL:
    return sa.URL.create(
        "postgresql+pg8000",
        postgresql.USER,
        postgresql.PASSWORD,
        database="postgres",
        query={"unix_sock": f"{folder}/.s.PGSQL.5432"},
    )


@contextmanager
def deployed(folder: Path, disk: Path, kind: StoreKind, *, dask: bool = False) -> Iterator[Deployment]:
    """What is to fly a campaign, begun: its temporary files in ``folder``, its store on ``disk``."""
    missions = folder / "tmp"
    missions.mkdir()
    port = free_port()
    home = disk / "home"
    environment = {**os.environ, "TMPDIR": str(missions), "ZENFI_HOME": str(home)}
    # What Dask's own processes leave behind when they are killed is none of ours.
    environment["DASK_TEMPORARY_DIRECTORY"] = str(folder / "dask")
    daemons: dict[str, Daemon] = {}

    def add(name: str, *command: str) -> None:
        daemons[name] = Daemon(command, environment, folder / f"{name}.log", folder)

    place, programs = folder / "postgresql", None
    if kind == "postgresql":
        place.mkdir()
        programs = postgresql.binaries()
        assert programs is not None, "no PostgreSQL server here"
        where = f"postgresql://{postgresql.USER}:{postgresql.PASSWORD}@/postgres?host={place}"
        store, readable = home, _postgresql(place)
    else:
        where, store, readable = str(disk / "store"), disk / "store", _sqlite(disk / "store")
    cluster = ""
    if not dask:
        add("service", sys.executable, "-m", "dashboard", "serve", "--store", where, "--port", str(port))
    if programs is not None:
        add("postgresql", *postgresql.prepared(place, programs))
    if dask:
        # The service flies on its own machine alone. Whatever has paused is resumed, as it is started again.
        add("command", ZENFI, "campaign", "resume", "1", "--store", where)
        at = free_port()
        cluster = f"tcp://127.0.0.1:{at}"
        module = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1"]
        add("scheduler", *module, "--port", str(at), "--dashboard-address", "127.0.0.1:0")
        module = [sys.executable, "-m", "distributed.cli.dask_worker", cluster]
        options = ["--no-nanny", "--nthreads", "1", "--resources", f"{RESOURCE}=1", "--host", "127.0.0.1"]
        for number in range(DASK_WORKERS):
            add(f"worker-{number}", *module, *options)
    address = f"http://127.0.0.1:{port}"
    one = Deployment(where, store, readable, home, address, cluster, daemons)
    try:
        yield one
    finally:
        with suppress(ProcessLookupError):
            one.close()
