"""Copies of a process: forks that have its memory and its main thread only, and end before it goes on.

Compiled, so that nothing of it depends on what the interpreter does, and not by fork(3), at which libraries
tidy up in the process as well: OpenBLAS gives its memory back.
"""

from __future__ import annotations

import errno
import signal

from numba import njit

from services.system import c_library
from services.system.lifeline import PR_SET_PDEATHSIG

IN_THE_COPY = 1
"""What :func:`fork_and_wait` is in the copy."""

_SIGCHLD, _SIGKILL, _EINTR = int(signal.SIGCHLD), int(signal.SIGKILL), errno.EINTR


@njit(cache=True)
def fork_and_wait() -> int:
    """Fork a copy: 1 in it, 0 in the process once the copy has ended, or an error's negative number.

    The copy dies with the process.
    """
    process = c_library.getpid()
    copy = c_library.syscall(c_library.CLONE, _SIGCHLD, 0, 0, 0, 0)
    if copy < 0:
        return -c_library.error()
    if copy:
        while c_library.waitpid(copy, 0, 0) < 0 and c_library.error() == _EINTR:
            pass
        return 0
    c_library.prctl(PR_SET_PDEATHSIG, _SIGKILL)
    if c_library.getppid() != process:
        c_library.exit_at_once(1)
    return IN_THE_COPY
