"""How a node says that it is there: a liveliness token whose key holds what identifies its process.

The token disappears with the process. What it says is a claim: whoever acts on a pid (the injector)
checks it against the kernel's own view first.
"""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from pathlib import Path

PREFIX = "node"
ALL = f"{PREFIX}/**"


@dataclass(frozen=True, slots=True)
class Announcement:
    """A node's claim about its process. ``start_ticks`` is field 22 of /proc/PID/stat."""

    name: str
    pid: int
    tid: int
    start_ticks: int
    boot_id: str

    @property
    def key(self) -> str:
        """The key of the liveliness token."""
        return f"{PREFIX}/{self.name}/{self.pid}/{self.tid}/{self.start_ticks}/{self.boot_id}"

    @classmethod
    def parse(cls, key: str) -> Announcement:
        """Read a token's key.

        :raises ValueError: if the key is not of the form that :attr:`key` writes.
        """
        prefix, name, pid, tid, start_ticks, boot_id = key.split("/")
        if prefix != PREFIX:
            message = f"not an announcement: {key}"
            raise ValueError(message)
        return cls(name, int(pid), int(tid), int(start_ticks), boot_id)


def announcement(name: str) -> Announcement:
    """The claim of the calling process, whose kernels run on the calling thread."""
    pid = os.getpid()
    return Announcement(name, pid, threading.get_native_id(), start_ticks(pid), boot_id())


def start_ticks(pid: int) -> int:
    """When a process started, in clock ticks since boot: with the pid, an identity within one boot."""
    stat = Path(f"/proc/{pid}/stat").read_text()
    return int(stat.rpartition(")")[2].split()[19])


def boot_id() -> str:
    """The identity of this boot of this machine."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
