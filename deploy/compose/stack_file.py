"""The format of stack files: the processes of a laboratory, what they need and how they are treated."""

from __future__ import annotations

import signal
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Annotated, Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, StringConstraints, field_validator, model_validator

from services.models.base import Strict

SUPERVISOR = "supervisor"
"""The name under which the supervisor's own log is asked for."""

NAME = r"^[a-z][a-z0-9_-]{0,30}$"
"""Names become parts of paths and keys."""

Name = Annotated[str, StringConstraints(pattern=NAME)]
Text = Annotated[str, StringConstraints(min_length=1, pattern=r"^[^\x00]*$")]
Seconds = Annotated[float, Field(gt=0, le=86_400)]


class ProcessSigns(Strict):
    """What is seen of a process from outside: all that is named here.

    ``announces`` is the name under which it declares its liveliness token (``services/bus/announce.py``),
    ``publishes`` the Zenoh key expression of its messages, ``http`` an address that answers 2xx.
    """

    announces: Name | None = None
    publishes: Text | None = None
    http: Text | None = None

    @field_validator("http")
    @classmethod
    def _plain_http(cls, value: str | None) -> str | None:
        parts = urlsplit(value or "http://localhost/")
        if parts.scheme != "http" or not parts.hostname or parts.username or parts.port == 0:
            raise ValueError("write an address such as http://127.0.0.1:8000/ready")
        return value

    @property
    def signs(self) -> frozenset[str]:
        """The signs that must be seen of a running process."""
        return frozenset(name for name in ("announces", "publishes", "http") if getattr(self, name))


class Readiness(ProcessSigns):
    """When a process counts as ready: all that is named here must have happened.

    ``publishes`` is seen with the first message; ``exits`` is that it has done its work and ended with
    status 0. Nothing named: ready once started.
    """

    exits: bool = False
    within_s: Seconds = 30.0

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if self.exits and self.signs:
            raise ValueError("a process that is ready when it exits has no other sign of readiness")
        return self


class Liveness(ProcessSigns):
    """How a process that is ready shows that it still works: it is probed ``every_s``.

    A probe fails if one of the signs is missing: no answer within ``timeout_s``, the announcement gone, no
    message since the last probe. After so many ``failures`` in a row the process is stopped as a failure.
    """

    every_s: Seconds = 10.0
    timeout_s: Seconds = 2.0
    failures: Annotated[int, Field(ge=1, le=1000)] = 3

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.signs:
            raise ValueError("name a sign: http, announces or publishes")
        return self


class ProcessLimits(Strict):
    """What a process may use: it is ended when all of its family take more than ``memory_bytes``.

    ``open_files`` is for each process of the family, and none of them can open more.
    """

    memory_bytes: Annotated[int, Field(ge=1_000_000)] | None = None
    open_files: Annotated[int, Field(ge=16)] | None = None


class BackOff(Strict):
    """The pause before a restart: ``first_s``, then each time ``factor`` as long, at most ``most_s``."""

    first_s: Seconds = 0.5
    factor: Annotated[float, Field(ge=1, le=10)] = 2.0
    most_s: Seconds = 30.0

    def pause_s(self, restarts: int) -> float:
        """The pause after so many restarts in a row."""
        # The power of a large number of restarts is more than a float holds.
        return float(min(self.first_s * self.factor ** min(restarts, 64), self.most_s))


class StopPolicy(Strict):
    """The signal that asks the process to end, and how long it may take until all of it is killed."""

    signal: Literal["SIGTERM", "SIGINT", "SIGQUIT", "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGKILL"] = "SIGTERM"
    grace_s: Seconds = 10.0

    @property
    def number(self) -> int:
        """The number of the stop signal."""
        return int(signal.Signals[self.signal])


class LogLimits(Strict):
    """A log is at most ``files`` files of ``file_bytes``; more than ``bytes_per_s`` is counted, not kept."""

    file_bytes: Annotated[int, Field(ge=1024)] = 10_000_000
    files: Annotated[int, Field(ge=1, le=100)] = 5
    bytes_per_s: Annotated[int, Field(ge=1024)] = 1_000_000


class ProcessSpec(Strict):
    """One process: ``command`` is run as it stands, by no shell.

    ``restarts`` is how many restarts in a row are tried; once it has been ready for ``settled_s`` they
    are counted anew. When one of ``restarts_with`` starts again, it ends before and starts after that.
    ``folder`` is where it works; ``environment`` is added to the supervisor's.
    """

    command: Annotated[tuple[Text, ...], Field(min_length=1)]
    needs: tuple[Name, ...] = ()
    restarts_with: tuple[Name, ...] = ()
    ready: Readiness = Readiness()
    alive: Liveness | None = None
    limits: ProcessLimits = ProcessLimits()
    restart: Literal["never", "on-failure", "always"] = "on-failure"
    restarts: Annotated[int, Field(ge=0, le=1_000_000)] = 5
    settled_s: Seconds = 10.0
    backoff: BackOff = BackOff()
    stop: StopPolicy = StopPolicy()
    environment: Mapping[
        Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")], Text | Literal[""]
    ] = {}
    folder: Text = "."
    log: LogLimits = LogLimits()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.ready.exits and self.restart == "always":
            raise ValueError('a process that is ready when it exits cannot have restart = "always"')
        if self.ready.exits and self.alive is not None:
            raise ValueError("a process that is ready when it exits cannot be probed: remove alive")
        if strangers := [name for name in self.restarts_with if name not in self.needs]:
            message = f"restarts_with names {strangers[0]}, which is not among its needs"
            raise ValueError(message)
        return self


class Bus(Strict):
    """Zenoh beyond this machine: endpoints on which the supervisor also listens, or to which it connects.

    ``tls`` is the folder of this machine that ``zenfi certificates`` has made. Without TLS only loopback is
    allowed, unless ``insecure`` says that the network is trusted.
    """

    listen: tuple[Text, ...] = ()
    connect: tuple[Text, ...] = ()
    insecure: bool = False
    tls: Text | None = None

    @model_validator(mode="after")
    def _closed(self) -> Self:
        for endpoint in (*self.listen, *self.connect):
            protocol, _, address = endpoint.partition("/")
            if protocol not in ("tcp", "tls"):
                message = f"{endpoint}: an endpoint is tls/HOST:PORT or tcp/HOST:PORT"
                raise ValueError(message)
            host = address.rpartition(":")[0]
            if protocol == "tcp" and host not in ("127.0.0.1", "[::1]", "localhost") and not self.insecure:
                message = f"{endpoint}: beyond this machine use tls/, or set insecure = true"
                raise ValueError(message)
            if protocol == "tls" and self.tls is None:
                message = f"{endpoint}: takes certificates: tls = FOLDER, made by zenfi certificates"
                raise ValueError(message)
        return self


class Stack(Strict):
    """A whole stack file. ``logs`` is the folder of the log files; by default the user's folder for state."""

    name: Name
    logs: Text | None = None
    bus: Bus = Bus()
    processes: Annotated[Mapping[Name, ProcessSpec], Field(min_length=1)]

    @model_validator(mode="after")
    def _orderly(self) -> Self:
        if SUPERVISOR in self.processes:
            message = f"{SUPERVISOR} is the name of the supervisor's own log: choose another"
            raise ValueError(message)
        for name, process in self.processes.items():
            for need in process.needs:
                if need not in self.processes:
                    message = f"{name} needs {need}, which is not declared"
                    raise ValueError(message)
        try:
            tuple(TopologicalSorter({n: p.needs for n, p in self.processes.items()}).static_order())
        except CycleError as error:
            message = f"processes need each other in a circle: {' needs '.join(reversed(error.args[1]))}"
            raise ValueError(message) from error
        return self
