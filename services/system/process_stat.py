"""State, times and memory of a process or thread, as proc_pid_stat(5) reports them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

CLOCK_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_LONGEST = 1024


class ProcessStat(NamedTuple):
    """``state`` is its one letter, ``cpu_s`` user and system time, ``start_ticks`` clock ticks since boot.

    ``flags`` are the kernel's own (PF_* of linux/sched.h), ``parent`` is its parent's pid,
    ``memory_bytes`` what of it is in memory, shared pages included.
    """

    state: str
    cpu_s: float
    start_ticks: int
    flags: int
    parent: int
    memory_bytes: int


def process_stat(pid: int) -> ProcessStat:
    """The status of a whole process: ``cpu_s`` is the sum over its threads.

    :raises OSError: if it is gone.
    """
    return _read(f"/proc/{pid}/stat")


def listed_pid(pid: int) -> int:
    """The number under which /proc lists a process: the one outside, where we are in a pid namespace.

    :raises OSError: if it is gone.
    """
    descriptor = os.pidfd_open(pid)
    try:
        return pid_of(descriptor)
    finally:
        os.close(descriptor)


def pid_of(descriptor: int) -> int:
    """The number under which /proc lists the process of a pidfd; -1 if it is gone."""
    info = Path(f"/proc/self/fdinfo/{descriptor}").read_text()
    return int(info.partition("\nPid:")[2].split(maxsplit=1)[0])


def own_number(pid: int) -> int:
    """The number that a process knows itself by, in its own pid namespace.

    :raises OSError: if it is gone.
    """
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("\nNSpid:")[2].partition("\n")[0].split()[-1])


def proportional_memory_bytes(pid: int, stat: ProcessStat) -> int:
    """What of a process is in memory, pages that it shares with others counted in part.

    With all its pages, as in its ``stat``, if the kernel does not tell us; nothing once it is gone.
    """
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except PermissionError:
        return stat.memory_bytes
    except OSError:
        return 0
    return sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))


def main_thread_stat(pid: int) -> ProcessStat:
    """The status of the first thread of a process alone.

    :raises OSError: if it is gone.
    """
    return _read(f"/proc/{pid}/task/{pid}/stat")


def is_stopped(pid: int) -> bool:
    """Whether somebody has stopped a process; not once it is gone."""
    try:
        return main_thread_stat(pid).state == "T"
    except OSError:
        return False


def wants_processor(pid: int) -> bool:
    """Whether a thread of a process runs, or would if processor and disk let it; not once it is gone."""
    try:
        return any(_read(f"{one}/stat").state in "RD" for one in Path(f"/proc/{pid}/task").iterdir())
    except OSError:  # a thread has ended meanwhile
        return False


def children(pid: int) -> list[int]:
    """The children of a process's main thread; none once it is gone."""
    try:
        return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def _read(path: str) -> ProcessStat:
    # Without a file object: a study asks several times for each injection.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        line = os.read(descriptor, _LONGEST)
    finally:
        os.close(descriptor)
    # The name, in brackets, may have brackets and blanks of its own.
    fields = line.rpartition(b")")[2].split()
    return ProcessStat(
        state=fields[0].decode(),
        cpu_s=(int(fields[11]) + int(fields[12])) / CLOCK_TICKS_PER_S,
        start_ticks=int(fields[19]),
        flags=int(fields[6]),
        parent=int(fields[1]),
        memory_bytes=int(fields[21]) * _PAGE_BYTES,
    )
