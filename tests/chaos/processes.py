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
from tests.conftest import descendants

SIDECARS = [name for name, process in STACK.items() if process.sidecar]
NAMED = {
    "deploy.workers.worker": "worker",
    "dashboard.api.processes.campaign_process": "campaign process",
    "serve": "service",
    "distributed.cli.dask_scheduler": "Dask scheduler",
    "distributed.cli.dask_worker": "Dask worker",
}
"""The class of a process whose command line has that word."""

SHARED = "/dev/shm"  # noqa: S108 - where the kernel has them
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


def segments() -> set[str]:
    """The segments of shared memory of this machine that no living process has."""
    mapped = ""
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with suppress(OSError):
            mapped += maps.read_text()
    rows = [line.split() for line in Path("/proc/sysvipc/shm").read_text().splitlines()[1:]]
    unused = {f"System V {row[1]}" for row in rows if row[6] == "0"}  # attached to nobody
    return unused | {str(file) for file in Path(SHARED).iterdir() if str(file) not in mapped}


def left_over(folder: Path, before: set[str]) -> list[str]:
    """Processes of this one, new segments, sockets in a folder, and files in its folder ``tmp``."""
    found = [f"process {pid} ({name})" for pid, name in descendants(os.getpid()).items()]
    listed = Path("/proc/net/unix").read_text().splitlines()
    found += [f"socket {line.split()[-1]}" for line in listed if f" {folder}/" in line]
    found += [f"segment {one}" for one in sorted(segments() - before)]
    return found + [f"file {entry}" for entry in (folder / "tmp").iterdir()]
