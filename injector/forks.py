"""Forks on order that all begin with the same memory: the loop is compiled (:mod:`services.bus.libc`)."""

from __future__ import annotations

import errno
import os

import numpy as np
from numba import njit
from numpy.typing import NDArray

from injector.own_pids import NEWPID, NOWHERE
from services.bus import libc

_OVER, _FORKED = 0, 1


def fork_on_order(orders: int, home: int = NOWHERE) -> bool:
    """Fork for each byte that comes until there are no more; True in the fork.

    This process has one thread. With a ``home`` (:func:`injector.own_pids.begin`) each fork is pid 1 of
    a namespace of its own. Unlike :func:`os.fork` it leaves the interpreter as it is.

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
    """Have the loop compiled."""
    reads, writes = os.pipe()
    os.close(writes)
    fork_on_order(reads)
    os.close(reads)


@njit(cache=True)
def _serve(orders: int, home: int, order: NDArray[np.uint8]) -> int:
    """``_OVER``, ``_FORKED`` or an error's negative number."""
    while True:
        got = libc.read(orders, order.ctypes.data, 1)
        if got == 0:
            return _OVER
        if got < 0 or (home >= 0 and libc.unshare(NEWPID)):
            return -libc.error()
        pid = libc.fork()
        if pid == 0:
            return _FORKED
        if pid < 0 or (home >= 0 and libc.setns(home, NEWPID)):
            return -libc.error()
