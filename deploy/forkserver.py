"""A clean fork server: imports once what every node needs, then forks a node in a few milliseconds.

This is the supervisor's end; the server's own process is :mod:`deploy.mould`. It dies with the process
that started it, and every node and courier dies with it.
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

from deploy.mould import EXIT_KEEPER, MESSAGE_SIZE, ZENOH_RUNTIME, server_argument
from deploy.stack import STACK, Process
from injector import pristine
from services.bus.node import NodeSetup
from services.bus.session import Meeting
from services.bus.vitals import Vitals

_GONE = "the fork server is gone"


class ForkServerError(Exception):
    """The fork server did not start or is gone."""


@dataclass(frozen=True, slots=True)
class Forked:
    """A process that was forked; ``pidfd`` is the caller's to close."""

    pid: int
    pidfd: int


@dataclass(frozen=True, slots=True)
class Exited:
    """A process's end: ``status`` as of :func:`os.waitstatus_to_exitcode` (negative: the signal)."""

    pid: int
    status: int


class ForkServer:
    """Starts the server, has processes forked, hears of their ends."""

    def __init__(self, stack: Mapping[str, Process] = STACK) -> None:
        self.stack = stack
        orders, self._orders = os.pipe()
        side_orders, self._side_orders = os.pipe()
        self.socket, papers = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # A session of its own: Ctrl-C at the terminal is the supervisor's business.
        self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            pristine.command("deploy.mould", server_argument(os.getpid())),
            env=pristine.environment(os.environ) | {"ZENOH_RUNTIME": ZENOH_RUNTIME},
            start_new_session=True,
            stdin=papers.fileno(),
        )
        papers.close()
        self._keepers: dict[int, int] = {}
        self._statuses: dict[int, int] = {}
        nodes, sidecars = (
            {process.name: process.module for process in stack.values() if process.sidecar == sidecar}
            for sidecar in (False, True)
        )
        socket.send_fds(self.socket, [json.dumps([nodes, sidecars]).encode()], [orders, side_orders])
        os.close(orders)
        os.close(side_orders)
        try:
            started = self.socket.recv(MESSAGE_SIZE)
        except ConnectionResetError:  # it ended before it had read what it is to import
            started = b""
        if not started:
            self.close()
            raise ForkServerError("the fork server did not start")
        self.fixed_pids = bool(json.loads(started)["fixed_pids"])
        """Whether the nodes' pids are the same in every flight (:mod:`injector.own_pids`)."""

    @property
    def pid(self) -> int:
        """The server's pid, whose descendants all nodes are."""
        return self._process.pid

    def is_lost(self, within_s: float = 0.0) -> bool:
        """Whether nobody takes orders for nodes, or none for sidecars, any more, now or ``within_s``."""
        return bool(self._loss().poll(within_s * 1000))

    def _loss(self) -> select.poll:
        """What tells that the last reader of either kind of orders is gone (poll(2): POLLERR)."""
        poll = select.poll()
        for orders in (self._orders, self._side_orders):
            poll.register(orders, 0)
        return poll

    def spawn(self, setup: NodeSetup, meeting: Meeting, vitals: Vitals, log: int, tracer_pid: int) -> Forked:
        """Fork a process. ``log`` takes its output, ``tracer_pid`` (0: nobody) may trace it."""
        sidecar = self.stack[setup.name].sidecar
        order = {
            "setup": setup.model_dump_json(),
            "meeting": json.dumps([str(meeting.folder), meeting.namespace]),
            "sidecar": sidecar,
            "tracer_pid": tracer_pid,
        }
        try:
            os.write(self._side_orders if sidecar else self._orders, b"+")
            socket.send_fds(self.socket, [json.dumps(order).encode()], [vitals.descriptor, log])
        except (BrokenPipeError, ConnectionResetError) as error:
            raise ForkServerError(_GONE) from error
        said = self._loss()
        said.register(self.socket, select.POLLIN)
        while said.poll() and _ready(self.socket.fileno()):
            forked = self._receive()
            if forked is not None:
                return forked
        raise ForkServerError(_GONE)

    def _receive(self) -> Forked | None:
        """Take in a keeper's message: what it has forked, or its process's end."""
        try:
            data, descriptors, _, _ = socket.recv_fds(self.socket, MESSAGE_SIZE, 2)
        except ConnectionResetError as error:  # it had not read all that it was told
            raise ForkServerError(_GONE) from error
        if not data:
            raise ForkServerError(_GONE)
        message = json.loads(data)
        pid = int(message["pid"])
        if "status" in message:
            self._statuses[pid] = int(message["status"])
            return None
        pidfd, self._keepers[pid] = descriptors
        return Forked(pid, pidfd)

    def exits(self) -> list[Exited]:
        """The processes that ended since the last call, their keepers too; does not block."""
        ended = [pid for pid, keeper in self._keepers.items() if _ready(keeper)]
        while _ready(self.socket.fileno()):
            self._receive()
        for pid in ended:
            os.close(self._keepers.pop(pid))
        # A keeper that ended without a word has failed.
        return [Exited(pid, self._statuses.pop(pid, EXIT_KEEPER)) for pid in ended]

    def discard(self, pid: int) -> None:
        """Kill a process and its keeper, which would wait for all that the process said to be recorded."""
        with contextlib.suppress(ProcessLookupError, KeyError):
            signal.pidfd_send_signal(self._keepers[pid], signal.SIGKILL)

    def close(self) -> None:
        """End the server, and with it every process that still runs."""
        os.close(self._orders)
        os.close(self._side_orders)
        self.socket.close()
        for keeper in self._keepers.values():
            os.close(keeper)
        self._process.wait()


def _ready(descriptor: int) -> bool:
    """Whether there is something to read; of a pidfd, whether the process has ended."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(0))
