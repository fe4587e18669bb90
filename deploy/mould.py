"""The fork server's own process: imports once what every node needs, and forks processes all alike.

It never opens a Zenoh session (a session does not survive a fork) and has one thread. For each order it
forks a *keeper*, which forks the process that was asked for before it does anything else: whatever was
flown before, that process begins with the same memory. The keeper of a node is its courier; it waits for
the process, reports its end, and ends. Every process dies with its keeper, and every keeper with us.

Sidecars come from a fork of this process that has imported what they alone need: some of that fills the
memory by chance (the hash maps of iced-x86), and a node's memory is to be the same in every server.
"""

from __future__ import annotations

import ctypes
import fcntl
import gc
import importlib
import json
import os
import signal
import socket
import struct
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from numba.core import event as numba_event

from deploy.stack import FOREIGN
from injector import forks, own_pids
from injector.keys import CONSTANT_RANDOM
from injector.pristine import begin_again_if
from injector.ward import ward_off_traps
from services.bus import scout
from services.bus.lifeline import die_with_parent
from services.bus.line import CourierLine, Line, NonsenseError, receive
from services.bus.messages import prepare
from services.bus.node import NodeSetup
from services.bus.process_stat import listed_pid
from services.bus.realtime import courier
from services.bus.session import Meeting, topic_key
from services.bus.topics import HORIZON_TYPE, TOPICS
from services.bus.vitals import Vitals

EXIT_BUG = 70
"""Exit status of a node that ended by an exception (sysexits.h: EX_SOFTWARE)."""

EXIT_KEEPER = 71
"""What is reported of a process whose keeper failed, which is our own failure."""

ORDERS, SIDE_ORDERS, PAPERS = 100, 101, 102
"""Its descriptors of the supervisor's orders for nodes and for sidecars, which come with the first papers,
and of the papers. Each byte is an order."""

ZENOH_RUNTIME = (
    "(acc: (handover: app), net: (handover: app), tx: (handover: app), rx: (handover: app),"
    " app: (worker_threads: 2))"
)
"""Two threads of Zenoh in a courier instead of six: a tenth less processor time for a flight."""

MESSAGE_SIZE = 1 << 20
SIDE_SERVER = "fork-sidecars"
"""The name of the process that forks the sidecars."""

_PR_SET_NAME = 15
_PR_SET_PTRACER = 0x59616D61
_DESCRIPTORS = struct.Struct("=2i")
_PAPERS = struct.Struct("<iII")
"""What a process gets first: its tracer, and the sizes of its setup and of the meeting."""

_libc = ctypes.CDLL(None, use_errno=True)


class ForkError(Exception):
    """A fork of this process would be broken."""


def server_argument(parent_pid: int) -> str:
    """The argument of the server's process, always as long."""
    return f"{parent_pid:010}"


def main() -> None:
    """Entry point: ``deploy.mould PARENT_PID``, with the papers' socket for standard input."""
    die_with_parent(int(sys.argv[1]))
    os.dup2(0, PAPERS)
    os.closerange(3, ORDERS)
    papers = socket.socket(fileno=PAPERS)
    # socket.recv_fds() peeks at nothing.
    message, ((_, _, rights),), _, _ = papers.recvmsg(
        MESSAGE_SIZE, socket.CMSG_LEN(_DESCRIPTORS.size), socket.MSG_PEEK
    )
    orders, side_orders = _DESCRIPTORS.unpack(rights)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for descriptor, wanted in ((orders, ORDERS), (side_orders, SIDE_ORDERS), (nothing, 0)):
        os.dup2(descriptor, wanted)
        os.close(descriptor)
    nodes, sidecars = json.loads(message)
    with numba_event.install_recorder("numba:compile") as compiled:
        modules = _imported(nodes)
    begin_again_if(bool(compiled.buffer), stdin=PAPERS)
    papers.recv(MESSAGE_SIZE)
    prepare(HORIZON_TYPE)
    for topic in TOPICS.values():
        topic_key(topic.name)
        prepare(topic.type)
    _fork_beside(sidecars, papers)
    home = own_pids.begin()
    gc.collect()
    gc.freeze()
    papers.send(json.dumps({"fixed_pids": home != own_pids.NOWHERE}).encode())
    _fork_on_order(papers, modules, home)
    # Without the interpreter's own clean-up: nanobind would complain of OMPL's leaks at length.
    os._exit(0)


def _imported(names: Mapping[str, str]) -> dict[str, ModuleType]:
    modules = {name: importlib.import_module(module) for name, module in names.items()}
    with _compiling_alone():
        for module in (forks, scout, *modules.values()):
            module.warm_up()
    threads = len(list(Path("/proc/self/task").iterdir()))
    if threads != 1:
        message = f"the fork server has {threads} threads; a fork of it would be broken"
        raise ForkError(message)
    return modules


@contextmanager
def _compiling_alone() -> Iterator[None]:
    """No other server of this checkout compiles meanwhile, also not if this one is killed.

    numba writes to a file with a random name and then renames it; here randomness is constant
    (:data:`CONSTANT_RANDOM`), so that two servers would write to the same.
    """
    with Path(__file__).open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _fork_beside(sidecars: Mapping[str, str], papers: socket.socket) -> None:
    """Fork the process that forks the sidecars.

    :raises ForkError: if it cannot import their modules.
    """
    own, theirs = socket.socketpair()
    server = os.getpid()
    if os.fork():
        theirs.close()
        os.close(SIDE_ORDERS)
        if not own.recv(1):
            raise ForkError("the sidecars' modules were not imported")
        own.close()
        return
    die_with_parent(server)
    _libc.prctl(_PR_SET_NAME, SIDE_SERVER.encode())
    own.close()
    os.dup2(SIDE_ORDERS, ORDERS)
    os.close(SIDE_ORDERS)
    modules = _imported(sidecars)
    gc.freeze()
    theirs.send(b"+")
    theirs.close()
    _fork_on_order(papers, modules)
    os._exit(0)


def _fork_on_order(
    papers: socket.socket, modules: Mapping[str, ModuleType], home: int = own_pids.NOWHERE
) -> None:
    """Fork a keeper for each order, until there are no more."""
    # Nobody is waited for: keepers report by themselves.
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    if forks.fork_on_order(ORDERS, home):
        _keep(papers, modules)


# -- the keeper --------------------------------------------------------------------------------------


def _keep(papers: socket.socket, modules: Mapping[str, ModuleType]) -> None:
    """Fork the process that is asked for, be its courier if it is a node, report its end.

    Nodes go on with constant random numbers; those who open a Zenoh session draw theirs.
    """
    die_with_parent()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.close(ORDERS)
    own, theirs = socket.socketpair()
    keeper = os.getpid()
    pid = os.fork()
    if not pid:
        die_with_parent(keeper)
        own.close()
        papers.close()
        _be(theirs, modules)
    theirs.close()
    CONSTANT_RANDOM.end()
    message, descriptors, _, _ = socket.recv_fds(papers, MESSAGE_SIZE, 2)
    listed = listed_pid(pid)
    socket.send_fds(
        papers, [json.dumps({"pid": listed}).encode()], [os.pidfd_open(pid), os.pidfd_open(os.getpid())]
    )
    status = EXIT_KEEPER
    try:
        _attend(own, pid, json.loads(message), descriptors)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    except BaseException:  # noqa: BLE001 - whatever ends a keeper is told in the log
        traceback.print_exc()
    papers.send(json.dumps({"pid": listed, "status": status}).encode())
    os._exit(0)


def _attend(end: socket.socket, pid: int, order: Mapping[str, str], descriptors: list[int]) -> None:
    vitals, log = descriptors
    os.dup2(log, 1)
    os.dup2(log, 2)
    setup = NodeSetup.model_validate_json(order["setup"])
    _libc.prctl(_PR_SET_NAME, f"courier-{setup.name}".encode())
    gc.disable()
    told, meeting = order["setup"].encode(), order["meeting"].encode()
    head = _PAPERS.pack(int(order["tracer_pid"]), len(told), len(meeting) if order["sidecar"] else 0)
    socket.send_fds(end, [head], descriptors)
    end.sendall(told)
    if order["sidecar"]:
        end.sendall(meeting)
        return
    folder, namespace = json.loads(meeting)
    bus = courier(setup, Meeting(Path(folder), namespace), CourierLine(end), pid, Vitals(vitals))
    try:
        bus.serve()
    except NonsenseError:
        traceback.print_exc()
        os.kill(pid, signal.SIGKILL)


# -- the process -------------------------------------------------------------------------------------


def _be(end: socket.socket, modules: Mapping[str, ModuleType]) -> None:
    """Be the process that the papers on the line tell of; does not return."""
    status = EXIT_BUG
    try:
        _run(end, modules)
        status = 0
    except BaseException:  # noqa: BLE001 - whatever ends a node is told in its log
        traceback.print_exc()
    finally:
        os._exit(status)


def _run(end: socket.socket, modules: Mapping[str, ModuleType]) -> None:
    head, descriptors, _, _ = socket.recv_fds(end, _PAPERS.size, 2)
    tracer_pid, setup_size, meeting_size = _PAPERS.unpack(head)
    page, log = descriptors
    os.dup2(log, 1)
    os.dup2(log, 2)
    # When a collection comes is no business of a kernel's.
    gc.disable()
    if tracer_pid:
        _libc.prctl(_PR_SET_PTRACER, tracer_pid, 0, 0, 0)
        ward_off_traps()
    setup = NodeSetup.model_validate_json(receive(end, setup_size))
    _libc.prctl(_PR_SET_NAME, f"zenfi-{setup.name}".encode())
    vitals = Vitals(page)
    if setup.spec.own_stage(setup.name) is not None:
        importlib.import_module(FOREIGN).main(setup, Line(end), vitals, tracer_pid)
        return
    if not meeting_size:
        modules[setup.name].main(setup, Line(end), vitals)
        return
    CONSTANT_RANDOM.end()
    folder, namespace = json.loads(receive(end, meeting_size))
    end.close()
    modules[setup.name].main(setup, Meeting(Path(folder), namespace), vitals)


if __name__ == "__main__":
    main()
