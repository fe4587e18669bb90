"""A clean fork server: imports once what every node needs, then forks a node in a few milliseconds.

It never opens a Zenoh session (a session does not survive a fork) and has one thread. Address
randomisation is off and the hash seed fixed, so that every node finds its code at the same addresses
in every flight. It dies with the process that started it, and every node dies with it.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import json
import os
import selectors
import socket
import subprocess
import sys
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from numba.core import event as numba_event

from deploy.stack import STACK, Process
from injector.ward import ward_off_traps
from services.bus.lifeline import die_with_parent
from services.bus.node import NodeSetup
from services.bus.session import Meeting, topic_key
from services.bus.topics import TOPICS
from services.bus.vitals import Vitals

PR_SET_NAME = 15
PR_SET_PTRACER = 0x59616D61
ADDR_NO_RANDOMIZE = 0x0040000
ZENOH_RUNTIME = (
    "(acc: (handover: app), net: (handover: app), tx: (handover: app), rx: (handover: app),"
    " app: (worker_threads: 2))"
)
"""Two threads of Zenoh in a node instead of six: each one more is one more to stop for an injection."""

EXIT_BUG = 70
"""Exit status of a node that ended by an exception (sysexits.h: EX_SOFTWARE)."""

_AGAIN = "again"
_MESSAGE_SIZE = 1 << 20
_libc = ctypes.CDLL(None, use_errno=True)


class ForkServerError(Exception):
    """The fork server did not start or is gone."""


@dataclass(frozen=True, slots=True)
class Exited:
    """A node's end: ``status`` as of :func:`os.waitstatus_to_exitcode` (negative: the signal)."""

    pid: int
    status: int


class ForkServer:
    """The supervisor's end: starts the server, has nodes forked, hears of their ends."""

    def __init__(self, stack: Mapping[str, Process] = STACK) -> None:
        self.stack = stack
        own, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket = own
        environment = {
            **os.environ,
            "PYTHONHASHSEED": "0",
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "ZENOH_RUNTIME": ZENOH_RUNTIME,
        }
        arguments = [sys.executable, "-m", "deploy.forkserver", str(theirs.fileno()), str(os.getpid())]
        # A session of its own: Ctrl-C at the terminal is the supervisor's business.
        self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            arguments,
            pass_fds=[theirs.fileno()],
            env=environment,
            start_new_session=True,
            stdin=subprocess.DEVNULL,
        )
        theirs.close()
        self._pending: list[Exited] = []
        own.send(json.dumps({process.name: process.module for process in stack.values()}).encode())
        if self._receive() != {"ready": True}:
            raise ForkServerError("the fork server did not start")

    @property
    def pid(self) -> int:
        """The server's pid, parent of all nodes."""
        return self._process.pid

    def _receive(self) -> dict[str, object]:
        data = self.socket.recv(_MESSAGE_SIZE)
        if not data:
            raise ForkServerError("the fork server is gone")
        message = json.loads(data)
        assert isinstance(message, dict)  # noqa: S101 - the other end is this module
        return message

    def spawn(self, setup: NodeSetup, meeting: Meeting, vitals: Vitals, log: int, tracer_pid: int) -> int:
        """Fork a node; its pid. ``log`` takes its output, ``tracer_pid`` (0: nobody) may trace it."""
        request = {
            "setup": setup.model_dump_json(),
            "folder": str(meeting.folder),
            "namespace": meeting.namespace,
            "tracer_pid": tracer_pid,
        }
        socket.send_fds(self.socket, [json.dumps(request).encode()], [vitals.descriptor, log])
        while True:
            message = self._receive()
            if "pid" in message and "status" not in message:
                return int(str(message["pid"]))
            self._pending.append(_exited(message))

    def exits(self) -> list[Exited]:
        """The ends of nodes since the last call; does not block."""
        self.socket.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                self._pending.append(_exited(self._receive()))
        self.socket.setblocking(True)
        exits, self._pending = self._pending, []
        return exits

    def close(self) -> None:
        """End the server, and with it every node that still runs."""
        self.socket.close()
        self._process.wait()


def _exited(message: dict[str, object]) -> Exited:
    return Exited(int(str(message["pid"])), int(str(message["status"])))


# -- the server's side -------------------------------------------------------------------------------


def _without_address_randomisation() -> None:
    """Start this process again with fixed addresses, unless it has them."""
    current = _libc.personality(0xFFFFFFFF)
    if not current & ADDR_NO_RANDOMIZE:
        _libc.personality(current | ADDR_NO_RANDOMIZE)
        _start_again()


def _start_again(*more: str) -> None:
    os.execv(sys.executable, [sys.executable, "-m", "deploy.forkserver", *sys.argv[1:], *more])  # noqa: S606


def serve(control: socket.socket) -> None:
    """Fork nodes on request and report their ends until the supervisor closes its end."""
    names = json.loads(control.recv(_MESSAGE_SIZE, socket.MSG_PEEK))
    with numba_event.install_recorder("numba:compile") as compiled:
        modules = {name: importlib.import_module(module) for name, module in names.items()}
        for module in modules.values():
            module.warm_up()
    if compiled.buffer and _AGAIN not in sys.argv:
        # What comes out of the cache lies elsewhere than what has just been compiled.
        _start_again(_AGAIN)
    control.recv(_MESSAGE_SIZE)
    for topic in TOPICS:
        topic_key(topic)
    gc.collect()
    gc.freeze()
    children: dict[int, int] = {}
    with selectors.DefaultSelector() as selector:
        selector.register(control, selectors.EVENT_READ)
        control.send(json.dumps({"ready": True}).encode())
        while True:
            for key, _ in selector.select():
                if key.fileobj is control:
                    data, descriptors, _, _ = socket.recv_fds(control, _MESSAGE_SIZE, 2)
                    if not data:
                        return
                    pid = _fork(json.loads(data), descriptors, modules, control)
                    pidfd = os.pidfd_open(pid)
                    children[pidfd] = pid
                    selector.register(pidfd, selectors.EVENT_READ)
                    control.send(json.dumps({"pid": pid}).encode())
                else:
                    pidfd = int(str(key.fileobj))
                    pid = children.pop(pidfd)
                    selector.unregister(pidfd)
                    os.close(pidfd)
                    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                    control.send(json.dumps({"pid": pid, "status": status}).encode())


def _fork(
    request: dict[str, str], descriptors: list[int], modules: Mapping[str, ModuleType], control: socket.socket
) -> int:
    threads = len(list(Path("/proc/self/task").iterdir()))
    if threads != 1:
        message = f"the fork server has {threads} threads; a fork of it would be broken"
        raise ForkServerError(message)
    server_pid = os.getpid()
    pid = os.fork()
    if pid:
        for descriptor in descriptors:
            os.close(descriptor)
        return pid
    status = EXIT_BUG
    try:
        die_with_parent(server_pid)
        control.close()
        _run_node(request, descriptors, modules)
        status = 0
    except BaseException:  # noqa: BLE001 - whatever ends a node is told in its log
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def _run_node(request: dict[str, str], descriptors: list[int], modules: Mapping[str, ModuleType]) -> None:
    vitals_descriptor, log = descriptors
    os.dup2(log, 1)
    os.dup2(log, 2)
    # A collection in the middle of a kernel would depend on what other threads allocated.
    gc.disable()
    if int(request["tracer_pid"]):
        _libc.prctl(PR_SET_PTRACER, int(request["tracer_pid"]), 0, 0, 0)
        ward_off_traps()
    setup = NodeSetup.model_validate_json(request["setup"])
    _libc.prctl(PR_SET_NAME, f"zenfi-{setup.name}".encode())
    meeting = Meeting(Path(request["folder"]), request["namespace"])
    vitals = Vitals(vitals_descriptor)
    modules[setup.name].main(setup, meeting, vitals)


def main() -> None:
    """Entry point of the server's process: ``python -m deploy.forkserver FD PARENT_PID``."""
    _without_address_randomisation()
    die_with_parent(int(sys.argv[2]))
    with socket.socket(fileno=int(sys.argv[1])) as control:
        serve(control)
    # Without the interpreter's own clean-up: nanobind would complain of OMPL's leaks at length.
    os._exit(0)


if __name__ == "__main__":
    main()
