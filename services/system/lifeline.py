"""Ends a process of ours when the process that started it dies, whatever the cause."""

from __future__ import annotations

import os
import signal

from services.system.libc import libc

PR_SET_PDEATHSIG = 1


def die_with_parent(parent_pid: int | None = None) -> None:
    """Have the kernel kill this process when its parent ends; end at once if ``parent_pid`` has already."""
    libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if parent_pid is not None and os.getppid() != parent_pid:
        os._exit(1)
