"""The processes that a campaign involves, by class, and what of them is left when all has ended."""

from __future__ import annotations

import ctypes
import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from deploy.config.processes import STACK
from deploy.mission.fork_protocol import SIDE_SERVER
from injector.reproducible.pid_namespace import CALLER
from services.system.libc import libc
from services.system.process_stat import process_stat
from tests.conftest import descendants, segments

SIDECARS = [name for name, process in STACK.items() if process.sidecar]
NAMED = {
    "deploy.workers.worker": "worker",
    "dashboard.api.processes.campaign_process": "campaign process",
    "serve": "service",
    "distributed.cli.dask_scheduler": "Dask scheduler",
    "distributed.cli.dask_worker": "Dask worker",
}
"""The class of a process whose command line has that word."""

_SET_SUBREAPER, _GET_SUBREAPER = 36, 37


def class_of(name: str, words: Sequence[str], parent: str) -> str:
    """The class of a process by its name, its command line and its parent's class; empty if it has none."""
    kind, _, own = name.partition("-")
    program = Path(words[0]).name if words else ""
    if kind == "proxy":
        return "reaper" if own in SIDECARS else "proxy"
    if kind == "zenfi":
        return own if own in SIDECARS else "node"
    if program.startswith("postgres: "):
        return "PostgreSQL session" if "zenfi" in program else ""
    if program == "postgres":
        return "PostgreSQL server"
    named = next((found for word, found in NAMED.items() if word in words), "")
    is_server = name in (SIDE_SERVER, CALLER) or parent == "worker"
    return named or ("fork server" if is_server else "")


def by_class(root: int) -> dict[str, list[int]]:
    """The living descendants of a process that have a class, by class, the oldest first."""
    classes: dict[int, str] = {}
    found: dict[str, list[int]] = defaultdict(list)
    for pid, name in descendants(root).items():  # parents before their children
        with suppress(OSError):
            words = Path(f"/proc/{pid}/cmdline").read_text(errors="replace").rstrip("\0").split("\0")
            classes[pid] = class_of(name, words, classes.get(process_stat(pid).parent, ""))
            if classes[pid]:
                found[classes[pid]].append(pid)
    return {name: sorted(pids) for name, pids in sorted(found.items())}


@contextmanager
def adopting() -> Iterator[None]:
    """Have processes whose parent has died become children of this one, so that none gets out of sight."""
    before = ctypes.c_int()
    libc.prctl(_GET_SUBREAPER, ctypes.byref(before))
    libc.prctl(_SET_SUBREAPER, 1)
    try:
        yield
    finally:
        libc.prctl(_SET_SUBREAPER, before.value)


def bury(own: Sequence[int]) -> None:
    """Take note of the ends of adopted processes: all children but ``own``, whose ends others wait for."""
    with suppress(ChildProcessError):
        for entry in Path(f"/proc/{os.getpid()}/task").iterdir():
            for pid in map(int, (entry / "children").read_text().split()):
                if pid not in own:
                    os.waitpid(pid, os.WNOHANG)


def left_over(folder: Path) -> list[str]:
    """Processes of this one, their segments, sockets in a folder, and files in its folder ``tmp``."""
    family = descendants(os.getpid())
    found = [f"process {pid} ({name})" for pid, name in family.items()]
    listed = Path("/proc/net/unix").read_text().splitlines()
    found += [f"socket {line.split()[-1]}" for line in listed if f" {folder}/" in line]
    found += [f"segment {one}" for one in segments(family)]
    return found + [f"file {entry}" for entry in (folder / "tmp").iterdir()]
