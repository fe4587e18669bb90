"""Announcements of nodes: liveliness tokens whose keys hold what identifies the process.

The token disappears with the process. What it says is a claim: whoever acts on a pid (the injector)
checks it against the kernel's own view first.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from services.system.process_stat import process_stat

PREFIX = "node"
ALL = f"{PREFIX}/**"


@dataclass(frozen=True, slots=True)
class Announcement:
    """A node's claim about its process. ``start_ticks`` is field 22 of /proc/PID/stat.

    ``executable`` are device and inode of what the process runs, if that is not our own interpreter.
    """

    name: str
    pid: int
    tid: int
    start_ticks: int
    boot_id: str
    executable: tuple[int, int] | None = None

    @property
    def key(self) -> str:
        """The key of the liveliness token."""
        runs = "" if self.executable is None else "/{}.{}".format(*self.executable)
        return f"{PREFIX}/{self.name}/{self.pid}/{self.tid}/{self.start_ticks}/{self.boot_id}{runs}"

    @classmethod
    def parse(cls, key: str) -> Announcement:
        """Parse the key of a liveliness token.

        :raises ValueError: if the key is not of the form that :attr:`key` writes.
        """
        prefix, name, pid, tid, start_ticks, boot_id, *runs = key.split("/")
        if prefix != PREFIX:
            message = f"not an announcement: {key}"
            raise ValueError(message)
        executable = None
        if runs:
            device, inode = runs[0].split(".")
            executable = int(device), int(inode)
        return cls(name, int(pid), int(tid), int(start_ticks), boot_id, executable)


def announcement(name: str, pid: int | None = None) -> Announcement:
    """The announcement of a process, by default the calling one; its kernels run on its first thread."""
    pid = os.getpid() if pid is None else pid
    return Announcement(name, pid, pid, start_ticks(pid), boot_id())


def start_ticks(pid: int) -> int:
    """When a process started, in clock ticks since boot: with the pid, an identity within one boot."""
    return process_stat(pid).start_ticks


@cache
def boot_id() -> str:
    """The identity of this boot of this machine."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
