"""The process of the fork server: imports once what every node needs, and forks processes all alike.

It never opens a Zenoh session (a session does not survive a fork) and has one thread. For each order it
forks a *reaper*, which forks the process that was asked for before it does anything else: whatever was
flown before, that process begins with the same memory. The reaper of a node is its proxy; it waits for
the process, reports its end, and ends. Every process dies with its reaper, and every reaper with us.

Sidecars come from a fork of this process that has imported what they alone need: some of that fills the
memory by chance (the hash maps of iced-x86), and a node's memory is to be the same in every server.
"""

from __future__ import annotations

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

from deploy.config.processes import FOREIGN
from deploy.mission.fork_protocol import EXIT_BUG, EXIT_NONSENSE, EXIT_REAPER, MESSAGE_SIZE, SIDE_SERVER
from injector.reproducible import compiled_code, fork_loop, pid_namespace
from injector.reproducible.bootstrap import STANDARD
from injector.reproducible.fatal_signals import ended_by_another, handle_fatal_signals
from injector.reproducible.fixed_libc import FIXED_LIBC
from injector.reproducible.forked_question import answered_by_a_fork
from injector.reproducible.installed_packages import offer_all_packages
from injector.reproducible.launch import begin_again_if, begin_again_to_compile
from injector.strikes.results import LINKS
from services.bus.messages import prepare
from services.bus.proxy_link import NodeLink, NonsenseError, ProxyLink, receive
from services.bus.session import BusAddress, topic_key
from services.bus.topics import TOPICS
from services.runtime import probe_gate
from services.runtime.realtime import proxy
from services.runtime.setup import NodeSetup
from services.system import plug_ins
from services.system.libc import libc
from services.system.lifeline import die_with_parent
from services.system.process_stat import listed_pid
from services.system.shared_stats import SharedStats

ORDERS, SIDE_ORDERS, PAPERS = 100, 101, 102
"""Its descriptors of the supervisor's orders for nodes and for sidecars, which come with the first papers,
and of the papers. Each byte is an order."""

_PR_SET_NAME = 15
_PR_SET_PTRACER = 0x59616D61
_DESCRIPTORS = struct.Struct("=2i")
_PAPERS = struct.Struct("<iII")
"""What a process gets first: its tracer, and the sizes of its setup and of the bus address."""


class ForkError(Exception):
    """A fork of this process would not work, e.g. since it has other threads."""


def main() -> None:
    """Entry point: ``deploy.mission.zygote PARENT_PID``, with the papers' socket for standard input."""
    die_with_parent(int(sys.argv[1]))
    os.dup2(STANDARD[0], PAPERS)
    os.closerange(3, ORDERS)
    papers = socket.socket(fileno=PAPERS)
    # socket.recv_fds() peeks at nothing.
    message, ((_, _, rights),), _, _ = papers.recvmsg(
        MESSAGE_SIZE, socket.CMSG_LEN(_DESCRIPTORS.size), socket.MSG_PEEK
    )
    orders, side_orders = _DESCRIPTORS.unpack(rights)
    for descriptor, wanted in ((orders, ORDERS), (side_orders, SIDE_ORDERS)):
        os.dup2(descriptor, wanted)
        os.close(descriptor)
    nodes, sidecars = json.loads(message)
    with numba_event.install_recorder("numba:compile") as compiled:
        modules = _imported(nodes)
        begin_again_to_compile(stdin=PAPERS)
        _warm_up(modules)
    begin_again_if(bool(compiled.buffer), stdin=PAPERS)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    papers.recv(MESSAGE_SIZE)
    for topic in TOPICS.values():
        topic_key(topic.name)
        prepare(topic.type)
    _fork_beside(sidecars, papers)
    home = pid_namespace.begin()
    gc.collect()
    gc.freeze()
    told = {"fixed_pids": home != pid_namespace.NOWHERE, "installation": compiled_code.folder().name}
    papers.send(json.dumps(told).encode())
    _fork_on_order(papers, modules, home)
    # Without the interpreter's own clean-up: nanobind would complain of OMPL's leaks at length.
    os._exit(0)


def _imported(names: Mapping[str, str]) -> dict[str, ModuleType]:
    return {name: importlib.import_module(module) for name, module in names.items()}


def _warm_up(modules: Mapping[str, ModuleType]) -> None:
    """Have the modules compile what they need, or load it.

    :raises ForkError: if they leave a thread behind.
    """
    with _compiling_alone():
        for module in (fork_loop, probe_gate, *modules.values()):
            module.warm_up()
    if not answered_by_a_fork(_parent_has_one_thread):
        raise ForkError("the fork server has several threads; a fork of it would be broken")


def _parent_has_one_thread() -> bool:
    return len(list(Path(f"/proc/{os.getppid()}/task").iterdir())) == 1


@contextmanager
def _compiling_alone() -> Iterator[None]:
    """Hold the lock under which one server of this checkout at a time compiles, even if one is killed.

    numba writes to a file with a random name and then renames it; here randomness is constant
    (:data:`FIXED_LIBC`), so that two servers would write to the same.
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
    libc.prctl(_PR_SET_NAME, SIDE_SERVER.encode())
    own.close()
    os.dup2(SIDE_ORDERS, ORDERS)
    os.close(SIDE_ORDERS)
    offer_all_packages()  # a detector of somebody's own may want them
    modules = _imported(sidecars)
    _warm_up(modules)
    gc.freeze()
    theirs.send(b"+")
    theirs.close()
    _fork_on_order(papers, modules)
    os._exit(0)


def _fork_on_order(
    papers: socket.socket, modules: Mapping[str, ModuleType], home: int = pid_namespace.NOWHERE
) -> None:
    """Fork a reaper for each order, until the supervisor closes the pipe."""
    # Nobody is waited for: reapers report by themselves.
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    if fork_loop.fork_on_order(ORDERS, home):
        _keep(papers, modules)


# -- the reaper --------------------------------------------------------------------------------------


def _keep(papers: socket.socket, modules: Mapping[str, ModuleType]) -> None:
    """Fork the requested process, serve as its proxy if it is a node, and report its end.

    Nodes go on with constant random numbers; those who open a Zenoh session draw theirs.
    """
    die_with_parent()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.close(ORDERS)
    own, theirs = socket.socketpair()
    origin, told_of_it = os.pipe()
    reaper = os.getpid()
    pid = os.fork()
    if not pid:
        die_with_parent(reaper)
        own.close()
        os.close(origin)
        papers.close()
        _be(theirs, told_of_it, modules)
    theirs.close()
    os.close(told_of_it)
    FIXED_LIBC.end()
    message, descriptors, _, _ = socket.recv_fds(papers, MESSAGE_SIZE, 2)
    listed = listed_pid(pid)
    socket.send_fds(
        papers, [json.dumps({"pid": listed}).encode()], [os.pidfd_open(pid), os.pidfd_open(os.getpid())]
    )
    status, by_another = EXIT_REAPER, False
    try:
        sound = _attend(own, pid, json.loads(message), descriptors)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        if sound:
            by_another = ended_by_another(status, origin)
        else:
            status = EXIT_NONSENSE
    except BaseException:  # noqa: BLE001 - whatever ends a reaper is in the log
        traceback.print_exc()
    papers.send(json.dumps({"pid": listed, "status": status, "by_another": by_another}).encode())
    os._exit(0)


def _attend(end: socket.socket, pid: int, order: Mapping[str, str], descriptors: list[int]) -> bool:
    """Give the process what it needs and, if it is a node, serve it; False if it had to be killed."""
    stats, log = descriptors
    os.dup2(log, 1)
    os.dup2(log, 2)
    setup = NodeSetup.model_validate_json(order["setup"])
    libc.prctl(_PR_SET_NAME, f"proxy-{setup.name}".encode())
    gc.disable()
    given, address = order["setup"].encode(), order["meeting"].encode()
    head = _PAPERS.pack(int(order["tracer_pid"]), len(given), len(address) if order["sidecar"] else 0)
    socket.send_fds(end, [head], descriptors)
    end.sendall(given)
    if order["sidecar"]:
        end.sendall(address)
        return True
    folder, namespace = json.loads(address)
    if order["alone"]:
        _hand_over(end, pid, Path(folder) / LINKS)
        return True
    bus = proxy(setup, BusAddress(Path(folder), namespace), ProxyLink(end), pid, SharedStats(stats))
    try:
        bus.serve()
    except NonsenseError:
        traceback.print_exc()
        os.kill(pid, signal.SIGKILL)
        return False
    return True


def _hand_over(end: socket.socket, pid: int, links: Path) -> None:
    """Have somebody else serve the node; wait for its end, and bury its copies, who are children of ours."""
    with socket.socket(socket.AF_UNIX) as line:
        line.connect(str(links))
        socket.send_fds(line, [str(listed_pid(pid)).encode()], [end.fileno()])
    end.close()
    while os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        found = os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)
        if found is not None and found.si_pid != pid:
            os.waitpid(found.si_pid, 0)


# -- the process -------------------------------------------------------------------------------------


def _be(end: socket.socket, origin: int, modules: Mapping[str, ModuleType]) -> None:
    """Become the process that the setup on the socket describes; does not return."""
    status = EXIT_BUG
    try:
        handle_fatal_signals(origin)
        _run(end, modules)
        status = 0
    except BaseException:  # noqa: BLE001 - whatever ends a node is in its log
        traceback.print_exc()
    finally:
        os._exit(status)


def _run(end: socket.socket, modules: Mapping[str, ModuleType]) -> None:
    head, descriptors, _, _ = socket.recv_fds(end, _PAPERS.size, 2)
    tracer_pid, setup_size, address_size = _PAPERS.unpack(head)
    page, log = descriptors
    os.dup2(log, 1)
    os.dup2(log, 2)
    # When a collection comes is no business of a kernel's.
    gc.disable()
    if tracer_pid:
        libc.prctl(_PR_SET_PTRACER, tracer_pid, 0, 0, 0)
    setup = NodeSetup.model_validate_json(receive(end, setup_size))
    plug_ins.tell(setup.plug_ins)
    libc.prctl(_PR_SET_NAME, f"zenfi-{setup.name}".encode())
    stats = SharedStats(page)
    if setup.spec.own_stage(setup.name) is not None:
        importlib.import_module(FOREIGN).main(setup, NodeLink(end), stats, tracer_pid)
        return
    if not address_size:
        modules[setup.name].main(setup, NodeLink(end), stats)
        return
    FIXED_LIBC.end()
    folder, namespace = json.loads(receive(end, address_size))
    end.close()
    modules[setup.name].main(setup, BusAddress(Path(folder), namespace), stats)


if __name__ == "__main__":
    main()
