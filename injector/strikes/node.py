"""The striker as a process: it is given a node, a task and a recorded flight, and tells line by line."""

from __future__ import annotations

import os
import socket
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

from injector.kernel_study.remote_fork import RemoteForkError
from injector.strikes.copied_node import DiedError, DisturbedCopyError, HangError
from injector.strikes.recorded_bus import StrayedError
from injector.strikes.results import LINKS, LOG, TASKS, StrikeLine, StrikeRecord, StrikeTask
from injector.strikes.striker import Striker
from injector.tracing.ptrace import GoneError
from injector.tracing.tracees import TraceeGroup
from services.bus import proxy_link
from services.bus.horizon import Stamped
from services.bus.session import BusAddress
from services.bus.topics import TOPICS
from services.runtime.kernel_timer import GATE_SIGNAL
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats


def warm_up() -> None:
    """Do nothing: no code of the striker is compiled."""


def main(setup: NodeSetup, address: BusAddress, _own: SharedStats) -> None:
    """Take one task, strike, tell, end. Nothing of the bus is used."""
    with socket.socket(socket.AF_UNIX) as links, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as line:
        links.bind(str(address.folder / LINKS))
        links.listen()
        line.connect(str(address.folder / TASKS))
        _, (asked, recording, page), *_ = socket.recv_fds(line, 1, 3)
        with os.fdopen(asked, "rb") as file:
            task = StrikeTask.model_validate_json(file.read())
        handed, _ = links.accept()
        with handed:
            pid_text, (end,), *_ = socket.recv_fds(handed, 64, 1)
        fault = task.faults[0]
        stats, log = SharedStats(page), address.folder / LOG
        with TraceeGroup(GATE_SIGNAL, forks=True) as tracees, socket.socket(fileno=end) as node_end:
            striker = Striker(task, setup.kernels.index(fault.target), _read(recording), stats, tracees, log)
            for told in _lines(striker.run(int(pid_text), node_end)):
                line.send(told.model_dump_json(by_alias=True).encode())


def _lines(strikes: Iterator[StrikeRecord]) -> Iterator[StrikeLine]:
    """What is told of strikes, to the end or to what keeps us from making more."""
    try:
        for strike in strikes:
            yield StrikeLine(strike=strike)
    except StrayedError as error:
        yield StrikeLine(problem=f"alone, the node sent something else than in its flight: {error}")
    except (DiedError, HangError, DisturbedCopyError, GoneError, RemoteForkError) as error:
        yield StrikeLine(problem=f"the node was lost: {error or type(error).__name__}", disturbed=True)
    else:
        yield StrikeLine(done=True)


def _read(recording: int) -> Mapping[str, Sequence[Stamped]]:
    """The messages of a flight from a descriptor, by topic."""
    names = tuple(TOPICS)
    messages: dict[str, list[Stamped]] = defaultdict(list)
    with os.fdopen(recording, "rb") as file:
        for number, message in proxy_link.unpack(file.read()):
            messages[names[number]].append(message)
    return messages
