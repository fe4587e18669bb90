"""Processes that the service has started, and the nodes that announce themselves on their buses."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import zenoh
from fastapi import APIRouter

from dashboard.api.service import Service, ServiceDep
from deploy.compose.control import StackView, stacks_up
from deploy.config.workdir import PREFIX
from services.bus import announce
from services.bus.messages import MalformedMessageError
from services.bus.ports import promise_of
from services.bus.session import HISTORY_KEY, BusAddress, open_visitor
from services.bus.topics import STAGES
from services.models.base import Strict
from services.runtime.bus_proxy import LIFE_SHIFT
from services.system.process_stat import process_stat

router = APIRouter(tags=["processes"])

ANSWER_S = 1.0
TAIL_BYTES = 2000
"""Of a node's log, its end."""


class ProcessInfo(Strict):
    """A process of the service; ``campaign`` names the campaign or study that it makes, if any."""

    pid: int
    parent: int
    name: str
    state: str
    cpu_s: float
    memory_bytes: int
    campaign: str = ""


class NodeInfo(Strict):
    """A node, as it announces itself, and what the kernel tells of its process; ``bus`` is its mission's.

    ``memory_bytes`` counts shared pages with each; ``restarts`` is None of sidecars.
    """

    bus: str
    name: str
    pid: int
    cpu_s: float
    memory_bytes: int
    restarts: int | None
    log: str


class ProcessList(Strict):
    """The service with all that it has started, parents first, and the stacks of `zenfi up`."""

    service: list[ProcessInfo]
    stacks: list[StackView]


@router.get("/processes")
def list_processes(service: ServiceDep) -> ProcessList:
    """The processes of the service, and this user's stacks on this machine."""
    return ProcessList(service=_own(service), stacks=stacks_up())


def _own(service: Service) -> list[ProcessInfo]:
    processes = service.runner.processes | service.program_studies.processes
    campaigns = {pid: label for label, pid in processes.items()}
    return [one.model_copy(update={"campaign": campaigns.get(one.pid, "")}) for one in family(os.getpid())]


@router.get("/nodes")
def list_nodes(service: ServiceDep) -> list[NodeInfo]:
    """The nodes that are on a bus now, of every mission that the service flies."""
    owners = {process.pid for process in _own(service)}
    return [node for folder in _meetings(owners) for node in _announced(folder)]


def family(root: int) -> list[ProcessInfo]:
    """A process, its children and so on."""
    found: list[ProcessInfo] = []
    waiting = [(root, os.getppid())]
    while waiting:
        pid, parent = waiting.pop(0)
        try:
            stat = process_stat(pid)
            name = _name(pid)
            threads = list(Path(f"/proc/{pid}/task").iterdir())
            children = [child for thread in threads for child in (thread / "children").read_text().split()]
        except OSError:
            continue  # it has ended meanwhile
        found.append(
            ProcessInfo(
                pid=pid,
                parent=parent,
                name=name,
                state=stat.state,
                cpu_s=stat.cpu_s,
                memory_bytes=stat.memory_bytes,
            )
        )
        waiting += [(int(child), pid) for child in children]
    return found


def _name(pid: int) -> str:
    """What a process calls itself; of Python that was not told another name, the module that it runs.

    :raises OSError: if it is gone.
    """
    name = Path(f"/proc/{pid}/comm").read_text().strip()
    words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    if name.startswith("python") and "-m" in words[:-1]:
        return words[words.index("-m") + 1]
    return name


def _meetings(owners: set[int]) -> Iterator[Path]:
    """The folders of missions that are supervised by any of ``owners``."""
    for folder in sorted(Path(tempfile.gettempdir()).glob(f"{PREFIX}*-*-*")):
        owner = folder.name.removeprefix(PREFIX).split("-", 1)[0]
        if owner.isdecimal() and int(owner) in owners:
            yield folder


def _announced(folder: Path) -> list[NodeInfo]:
    try:
        with open_visitor(BusAddress(folder, f"zenfi/{folder.name}")) as bus:
            replies = list(bus.liveliness().get(announce.ALL, timeout=ANSWER_S))
            lives = _lives(bus)
    except zenoh.ZError:
        return []  # the mission has ended meanwhile
    claims = [announce.Announcement.parse(str(reply.ok.key_expr)) for reply in replies if reply.ok]
    found = (_node(folder, claim, lives) for claim in sorted(claims, key=lambda claim: claim.name))
    return [node for node in found if node is not None]


def _lives(bus: zenoh.Session) -> dict[str, int]:
    """How often each stage was started again: its promises tell."""
    found: dict[str, int] = {}
    for stage in STAGES:
        for reply in bus.get(f"{HISTORY_KEY}/horizon/{stage}", timeout=ANSWER_S):
            if reply.ok:
                with suppress(MalformedMessageError):
                    found[stage] = int(promise_of(stage, reply.ok.payload.to_bytes()).serial) >> LIFE_SHIFT
    return found


def _node(folder: Path, claim: announce.Announcement, lives: dict[str, int]) -> NodeInfo | None:
    """None if its process has ended meanwhile."""
    try:
        stat = process_stat(claim.pid)
        with (folder / f"{claim.name}.log").open("rb") as log:
            log.seek(max(os.fstat(log.fileno()).st_size - TAIL_BYTES, 0))
            tail = log.read().decode(errors="replace")
    except OSError:
        return None
    return NodeInfo(
        bus=folder.name,
        name=claim.name,
        pid=claim.pid,
        cpu_s=stat.cpu_s,
        memory_bytes=stat.memory_bytes,
        restarts=lives.get(claim.name),
        log=tail.strip(),
    )
