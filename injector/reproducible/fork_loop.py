"""A compiled loop that forks processes on request, so that all of them begin with the same memory.

It calls the C library through :mod:`services.system.c_library`.
"""

from __future__ import annotations

import errno
import os

import numpy as np
from numba import njit
from numpy.typing import NDArray

from injector.reproducible.pid_namespace import NEWPID, NOWHERE
from services.system import c_library

_OVER, _FORKED = 0, 1


def fork_on_order(orders: int, home: int = NOWHERE) -> bool:
    """Fork for each byte that comes until there are no more; True in the fork.

    This process has one thread. With a ``home`` (:func:`injector.reproducible.pid_namespace.begin`) each fork
    is pid 1 of a namespace of its own. Unlike :func:`os.fork` it leaves the interpreter as it is.

    :raises OSError: if there is no fork or no namespace to be had.
    """
    order = np.zeros(1, np.uint8)
    while (answer := _serve(orders, home, order)) == -errno.EINTR:
        pass  # the interpreter sees to its signals
    if answer < 0:
        raise OSError(-answer, os.strerror(-answer))
    if answer == _FORKED and home != NOWHERE:
        os.close(home)
    return bool(answer == _FORKED)


def warm_up() -> None:
    """Compile the loop, or load it from numba's cache."""
    reads, writes = os.pipe()
    os.close(writes)
    fork_on_order(reads)
    os.close(reads)


@njit(cache=True)
def _serve(orders: int, home: int, order: NDArray[np.uint8]) -> int:
    """``_OVER``, ``_FORKED`` or an error's negative number."""
    while True:
        got = c_library.read(orders, order.ctypes.data, 1)
        if got == 0:
            return _OVER
        if got < 0 or (home >= 0 and c_library.unshare(NEWPID)):
            return -c_library.error()
        pid = c_library.fork()
        if pid == 0:
            return _FORKED
        if pid < 0 or (home >= 0 and c_library.setns(home, NEWPID)):
            return -c_library.error()
