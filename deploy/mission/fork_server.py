"""A clean fork server: imports once what every node needs, then forks a node in a few milliseconds.

This is the supervisor's end; the server's own process is :mod:`deploy.mission.zygote`. It dies with the
process that started it, and every node and proxy dies with it.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from deploy.config.processes import STACK, ProcessDeclaration
from deploy.mission.fork_protocol import EXIT_REAPER, MESSAGE_SIZE, ZENOH_RUNTIME, server_argument
from injector.reproducible import launch
from services.bus.session import BusAddress
from services.runtime.setup import NodeSetup
from services.system import plug_ins
from services.system.process_stat import children, is_stopped, pid_of
from services.system.shared_stats import SharedStats

if TYPE_CHECKING:
    from deploy.mission.far_processes import Companion

_GONE = "the fork server is gone"

STOPPED_S = 20.0
"""After so long a wait for a process it is looked whether somebody has stopped the server."""


class ForkServerError(Exception):
    """The fork server did not start or is gone."""


@dataclass(frozen=True, slots=True)
class Forked:
    """A process that was forked; ``pidfd`` is the caller's to close."""

    pid: int
    pidfd: int


@dataclass(frozen=True, slots=True)
class Exited:
    """A process's end: ``status`` as of :func:`os.waitstatus_to_exitcode` (negative: the signal).

    ``by_another``: another process has sent the signal, or has ended the reaper.
    """

    pid: int
    status: int
    by_another: bool = False


class ForkServer:
    """Starts the fork server, has processes forked and collects their exits."""

    def __init__(self, stack: Mapping[str, ProcessDeclaration] = STACK) -> None:
        self.stack = stack
        orders, self._orders = os.pipe()
        side_orders, self._side_orders = os.pipe()
        self.socket, papers = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # A session of its own: Ctrl-C at the terminal is the supervisor's business.
        self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            launch.command("deploy.mission.zygote", server_argument(os.getpid())),
            env=launch.environment(os.environ, compiled="flight") | {"ZENOH_RUNTIME": ZENOH_RUNTIME},
            start_new_session=True,
            stdin=papers.fileno(),
        )
        papers.close()
        self._reapers: dict[int, int] = {}
        self._exits: dict[int, Exited] = {}
        nodes, sidecars = (
            {process.name: process.module for process in stack.values() if process.sidecar == sidecar}
            for sidecar in (False, True)
        )
        socket.send_fds(self.socket, [json.dumps([nodes, sidecars]).encode()], [orders, side_orders])
        os.close(orders)
        os.close(side_orders)
        try:
            started = self.socket.recv(MESSAGE_SIZE) if self._speaks() else b""
        except ConnectionResetError:  # it ended before it had read what it is to import
            started = b""
        if not started:
            self.close()
            raise ForkServerError("the fork server did not start")
        self.companion: Companion | None = None
        """The computer on which stages run in this host's place, None for here."""
        told = json.loads(started)
        self.fixed_pids = bool(told["fixed_pids"])
        """Whether nodes have the same pids in every flight (:mod:`injector.reproducible.pid_namespace`)."""
        self.installation = "-".join(filter(None, (str(told["installation"]), plug_ins.digest())))
        """A name for all that decides on a node's code (:mod:`injector.reproducible.compiled_code`), with the
        plug-ins (:func:`services.system.plug_ins.digest`)."""

    @property
    def stage_pids_fixed(self) -> bool:
        """Whether stages have the same pids in every flight, wherever they run."""
        return self.fixed_pids if self.companion is None else self.companion.fixed_pids

    @property
    def pid(self) -> int:
        """The server's pid, whose descendants all nodes are."""
        return self._process.pid

    def is_lost(self, within_s: float = 0.0) -> bool:
        """Whether nobody takes orders for nodes, or none for sidecars, any more, now or ``within_s``."""
        return bool(self._loss().poll(within_s * 1000))

    def _loss(self) -> select.poll:
        """A poll object that reports POLLERR once no process reads either kind of orders any more."""
        poll = select.poll()
        for orders in (self._orders, self._side_orders):
            poll.register(orders, 0)
        return poll

    def spawn(
        self,
        setup: NodeSetup,
        address: BusAddress,
        stats: SharedStats,
        log: int,
        tracer_pid: int,
        *,
        alone: bool = False,
    ) -> Forked:
        """Fork a process. ``log`` takes its output, ``tracer_pid`` (0: nobody) may trace it.

        A node that is to run ``alone`` has no proxy: who listens for links in the folder serves it.
        """
        sidecar = self.stack[setup.name].sidecar
        order = {
            "setup": setup.model_dump_json(),
            "meeting": json.dumps([str(address.folder), address.namespace]),
            "sidecar": sidecar,
            "alone": alone,
            "tracer_pid": tracer_pid,
        }
        try:
            os.write(self._side_orders if sidecar else self._orders, b"+")
            socket.send_fds(self.socket, [json.dumps(order).encode()], [stats.descriptor, log])
        except (BrokenPipeError, ConnectionResetError) as error:
            raise ForkServerError(_GONE) from error
        while self._speaks():
            forked = self._receive()
            if forked is not None:
                return forked
        raise ForkServerError(_GONE)

    def _speaks(self) -> bool:
        """Wait until there is something to receive; False once the server is gone.

        One that somebody has stopped is ended, as it may never go on: whoever has it gets another one.
        """
        said = self._loss()
        said.register(self.socket, select.POLLIN)
        while not said.poll(STOPPED_S * 1000):
            self._end_if_stopped()
        return _ready(self.socket.fileno())

    def _end_if_stopped(self) -> None:
        if any(is_stopped(pid) for pid in (self.pid, *children(self.pid))):
            self._process.kill()

    def _receive(self) -> Forked | None:
        """Take in a reaper's message: what it has forked, or its process's end."""
        try:
            data, descriptors, _, _ = socket.recv_fds(self.socket, MESSAGE_SIZE, 2)
        except ConnectionResetError as error:  # it had not read all that was sent
            raise ForkServerError(_GONE) from error
        if not data:
            raise ForkServerError(_GONE)
        message = json.loads(data)
        pid = int(message["pid"])
        if "status" in message:
            self._exits[pid] = Exited(pid, int(message["status"]), bool(message["by_another"]))
            return None
        pidfd, self._reapers[pid] = descriptors
        return Forked(pid, pidfd)

    def exits(self) -> list[Exited]:
        """The processes that ended since the last call, their reapers too; does not block."""
        ended = [pid for pid, reaper in self._reapers.items() if _ready(reaper)]
        while _ready(self.socket.fileno()):
            self._receive()
        for pid in ended:
            os.close(self._reapers.pop(pid))
        # A reaper says what has failed; one that ended without a word was killed.
        return [self._exits.pop(pid, Exited(pid, EXIT_REAPER, by_another=True)) for pid in ended]

    def reaper_of(self, pid: int) -> int:
        """The pid of a process's reaper, of a node its proxy; -1 if it has ended."""
        descriptor = self._reapers.get(pid)
        return pid_of(descriptor) if descriptor is not None else -1

    def discard(self, pid: int) -> None:
        """Kill a process and its reaper, which would wait for all of its messages to be recorded."""
        with contextlib.suppress(ProcessLookupError, KeyError):
            signal.pidfd_send_signal(self._reapers[pid], signal.SIGKILL)

    def close(self) -> None:
        """End the server, and with it every process that still runs."""
        os.close(self._orders)
        os.close(self._side_orders)
        self.socket.close()
        for reaper in self._reapers.values():
            os.close(reaper)
        while True:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(STOPPED_S)
                return
            self._end_if_stopped()


def _ready(descriptor: int) -> bool:
    """Whether there is something to read; of a pidfd, whether the process has ended."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(0))
