"""Process families: who descends from whom, and how to end all of them.

A subreaper (prctl(2), PR_SET_CHILD_SUBREAPER) becomes the parent of every descendant whose own parent
has died, so what daemonises itself stays in the family.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import time
from collections.abc import Collection, Iterator
from pathlib import Path

from services.system.libc import libc
from services.system.process_stat import ProcessStat, process_stat

MARK = "ZENFI_STACK"
"""Environment variable of every process of a stack: the stack's private folder."""

NAMESPACE = "ZENFI_NAMESPACE"
"""Environment variable: the Zenoh namespace in which the processes of a stack meet."""

_PR_SET_CHILD_SUBREAPER = 36
_PAUSE_S = 0.002


def become_subreaper() -> None:
    """Make this process the parent of the orphans among its descendants.

    :raises OSError: if the kernel refuses.
    """
    if libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_CHILD_SUBREAPER)")


def processes() -> dict[int, ProcessStat]:
    """Every process of the machine that is not a zombie, by pid."""
    found = {}
    for entry in os.listdir("/proc"):  # noqa: PTH208 - names only, many of them
        if entry.isdigit():
            with contextlib.suppress(OSError):
                stat = process_stat(int(entry))
                if stat.state != "Z":
                    found[int(entry)] = stat
    return found


def descendants(pid: int, spare: Collection[int] = ()) -> dict[int, ProcessStat]:
    """The living children of a process, their children and so on, by pid; ``spare`` and theirs left out."""
    return _below({pid}, processes(), spare)


def _below(
    roots: Collection[int], everybody: dict[int, ProcessStat], spare: Collection[int]
) -> dict[int, ProcessStat]:
    children: dict[int, list[int]] = {}
    for one, stat in everybody.items():
        children.setdefault(stat.parent, []).append(one)
    found: dict[int, ProcessStat] = {}
    waiting = [child for root in roots for child in children.get(root, ())]
    while waiting:
        one = waiting.pop()
        if one not in spare and one not in found:
            found[one] = everybody[one]
            waiting += children.get(one, ())
    return found


def kill(pid: int, start_ticks: int) -> bool:
    """Kill a process, never another one that got its pid; False if the kernel refuses us."""
    with _held(pid, start_ticks) as pidfd:
        if pidfd is not None:
            try:
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            except PermissionError:
                return False
            except ProcessLookupError:
                pass
    return True


@contextlib.contextmanager
def _held(pid: int, start_ticks: int) -> Iterator[int | None]:
    """Open a descriptor of the process that began at ``start_ticks``; None if it is gone."""
    try:
        pidfd = os.pidfd_open(pid)
    except ProcessLookupError:
        yield None
        return
    try:
        same = process_stat(pid).start_ticks == start_ticks
    except OSError:
        same = False
    try:
        yield pidfd if same else None
    finally:
        os.close(pidfd)


def reaped() -> Iterator[tuple[int, int]]:
    """The children that have ended, as pid and status (negative: the signal); their zombies are gone."""
    with contextlib.suppress(ChildProcessError):
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            yield pid, os.waitstatus_to_exitcode(status)


def end_family() -> tuple[int, int]:
    """Kill every descendant of this subreaper and reap it; how many were killed, and how many refused.

    Who forks meanwhile is found in the next round; only a process of another user can refuse.
    """
    killed: set[tuple[int, int]] = set()
    while True:
        family = descendants(os.getpid())
        refused = 0
        for pid, stat in family.items():
            if kill(pid, stat.start_ticks):
                killed.add((pid, stat.start_ticks))
            else:
                refused += 1
        for _ in reaped():
            pass
        if _childless() or 0 < refused == len(family):
            return len(killed), refused
        time.sleep(_PAUSE_S)


def _childless() -> bool:
    """Whether this process has no child at all; a subreaper then has no descendant either."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return True
    return False


def kill_strays(reapers: Collection[int]) -> tuple[int, int]:
    """Kill, without waiting, what is neither one of the ``reapers`` nor theirs; how many, and refused."""
    family = descendants(os.getpid(), spare=reapers)
    killed = sum(kill(pid, stat.start_ticks) for pid, stat in family.items())
    return killed, len(family) - killed


def clear_marked(folder: Path) -> tuple[int, int]:
    """Kill what an earlier supervisor of the stack in ``folder`` has left, and wait for its end.

    How many were killed, and how many refused: only a process of another user can. The mark is in the
    environment that a process began with: whoever wipes it and outlives the supervisor *and* its reaper
    is not found.
    """
    mark = f"{MARK}={folder}".encode()
    killed: set[tuple[int, int]] = set()
    refused: set[tuple[int, int]] = set()
    left: dict[int, ProcessStat] = {}
    while left := _left(mark, left, refused):
        for pid, stat in left.items():
            with _held(pid, stat.start_ticks) as pidfd:
                if pidfd is None:
                    continue
                try:
                    signal.pidfd_send_signal(pidfd, signal.SIGKILL)
                    killed.add((pid, stat.start_ticks))
                except ProcessLookupError:  # its reaper clears up at the same time
                    pass
                except PermissionError:
                    refused.add((pid, stat.start_ticks))
                select.select([pidfd], [], [], _PAUSE_S)
    return len(killed), len(refused)


def _left(
    mark: bytes, before: dict[int, ProcessStat], refused: Collection[tuple[int, int]]
) -> dict[int, ProcessStat]:
    """Who is marked, descends from who is, or was found ``before``, and has not ended.

    A process that is ending has no environment any more, for a time that is long on a busy machine; its
    reaper, whose descendant it is, has one until it is over.
    """
    everybody = processes()
    found = {pid: stat for pid, stat in everybody.items() if _marked(pid, mark)}
    found |= _below(found, everybody, spare=[os.getpid()])
    for pid, stat in before.items():
        if pid in everybody and everybody[pid].start_ticks == stat.start_ticks:
            found[pid] = stat
    return {pid: stat for pid, stat in found.items() if (pid, stat.start_ticks) not in refused}


def _marked(pid: int, mark: bytes) -> bool:
    if pid == os.getpid():
        return False
    try:
        return mark in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return False
