"""Strike the calls of one node of a flight that has been flown, all in one run of that node alone."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from typing import BinaryIO

from deploy.config.workdir import mission_folder
from deploy.errors import DisturbedFlightError, InfrastructureError
from deploy.mission.flight import FlownMission
from deploy.mission.fork_server import Exited, Forked, ForkServer
from deploy.mission.setups import NodeSetups
from injector.strikes.results import LOG, TASKS, StrikeLine, StrikeRecord, StrikeTask
from services.bus import proxy_link
from services.bus.session import BusAddress
from services.bus.topics import TOPICS
from services.kernels import aimed_at
from services.models.faults.specification import FaultSpec
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats

_LONGEST = 1 << 20
STRIKER = "striker"

_BEGIN_S = 20.0
_LINE_S = 600.0
"""Wall time for a striker to tell of the next strike; on a loaded machine a call takes seconds to count."""

_END_S = 5.0
"""Wall time for what was killed to be gone."""


def strike(server: ForkServer, twin: FlownMission, faults: Sequence[FaultSpec]) -> Iterator[StrikeRecord]:
    """What becomes of each of ``faults``, all of one kernel, whose triggers name their calls.

    ``twin`` is the flight without them, with its messages.

    :raises DisturbedFlightError: if something from outside keeps the striker or its node from going on.
    :raises InfrastructureError: if they fail.
    """
    node = aimed_at(faults[0])
    spec = twin.outcome.spec.model_copy(update={"fault": FaultSpec(target=faults[0].target)})
    task = StrikeTask(
        node=node, seed=spec.seed, end_ns=twin.end_ns, watched=spec.detector is not None, faults=tuple(faults)
    )
    with ExitStack() as held:
        folder = held.enter_context(mission_folder())
        setup = NodeSetups(spec, server.stack, None, folder / "no true path").of(server.stack[node])
        stats = held.enter_context(closing(SharedStats.create(node)))
        listener = held.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        listener.bind(str(folder / TASKS))
        listener.listen()
        processes = held.enter_context(closing(_Processes(server, BusAddress(folder, folder.name))))
        striker = processes.start_striker(setup)
        listener.settimeout(_BEGIN_S)
        line = held.enter_context(listener.accept()[0])
        with _recorded(twin) as recording, _in_memory(task.model_dump_json().encode()) as asked:
            socket.send_fds(line, [b"."], [asked.fileno(), recording.fileno(), stats.descriptor])
        processes.start(setup, stats, striker)
        line.settimeout(_LINE_S)
        while not (told := _told(line, processes)).done:
            assert told.strike is not None  # noqa: S101 - a line is one or the other
            yield told.strike


class _Processes:
    """The striker and its node: started, and gone when closed."""

    def __init__(self, server: ForkServer, address: BusAddress) -> None:
        self._server, self._address = server, address
        self._running: dict[int, Forked] = {}
        self._striker = 0
        self._log = os.open(address.folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self._page = SharedStats.create(STRIKER)

    def start_striker(self, setup: NodeSetup) -> int:
        """Start the striker of the node that is set up so; its pid."""
        self._striker = self.start(setup.model_copy(update={"name": STRIKER}), self._page, 0, alone=False)
        return self._striker

    def start(self, setup: NodeSetup, stats: SharedStats, tracer_pid: int, *, alone: bool = True) -> int:
        """Start a process of the pass, a node or its striker; its pid."""
        forked = self._server.spawn(setup, self._address, stats, self._log, tracer_pid, alone=alone)
        self._running[forked.pid] = forked
        return forked.pid

    def loss(self) -> Exception:
        """Why the striker has ended before it had told all."""
        ends = self._ends(_END_S)
        if self._striker in self._running:  # its node noticed first
            ends += self._ends(_END_S)
        if any(one.by_another for one in ends):
            return DisturbedFlightError("the striker was ended from outside")
        said = (self._address.folder / LOG).read_text(errors="replace").strip().splitlines()
        return InfrastructureError(f"the striker has ended: {said[-1] if said else 'no output'}")

    def _ends(self, within_s: float) -> list[Exited]:
        """The ends of processes of ours, waited for."""
        deadline = time.monotonic() + within_s
        ends: list[Exited] = []
        while not ends and self._running and time.monotonic() < deadline:
            ends = [one for one in self._server.exits() if one.pid in self._running]
            time.sleep(0.001)
        for one in ends:
            os.close(self._running.pop(one.pid).pidfd)
        return ends

    def close(self) -> None:
        """Kill what still runs, and wait for it to be gone."""
        for pid in self._running:
            self._server.discard(pid)
        while self._ends(_END_S):
            pass
        os.close(self._log)
        self._page.close()


def _told(line: socket.socket, processes: _Processes) -> StrikeLine:
    """The next line that the striker has written.

    :raises DisturbedFlightError: if something from outside keeps it from going on.
    :raises InfrastructureError: if it has failed.
    """
    text = line.recv(_LONGEST)
    if not text:
        raise processes.loss()
    told = StrikeLine.model_validate_json(text)
    if told.problem:
        raise (DisturbedFlightError if told.disturbed else InfrastructureError)(told.problem)
    return told


def _recorded(twin: FlownMission) -> BinaryIO:
    """The flight's messages, as the striker reads them."""
    assert twin.messages is not None  # noqa: S101 - who wants strikes has kept them
    numbers = {name: number for number, name in enumerate(TOPICS)}
    every = ((numbers[topic], one) for topic, messages in twin.messages.items() for one in messages)
    return _in_memory(proxy_link.pack(list(every)))


def _in_memory(content: bytes) -> BinaryIO:
    """A file that nobody else sees, to be read from its beginning; what it has may be of any size."""
    file = os.fdopen(os.memfd_create("zenfi-strikes", os.MFD_CLOEXEC), "w+b")
    file.write(content)
    file.seek(0)
    return file
