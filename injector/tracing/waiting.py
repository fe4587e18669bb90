"""Waiting for tracees: asleep until one reports, and never without end."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from typing import TypeVar

SPIN_NS = 200_000
"""How long a wait polls before it sleeps: a single step takes 20 us, waking from sleep 15 us more."""

_SLICE_S = 0.001
"""Longest sleep of a wait: another thread of ours may have taken the SIGCHLD that was to end it."""

T = TypeVar("T")


def hear_of_children() -> set[signal.Signals]:
    """Hold SIGCHLD back in this thread, so that :func:`wait_until` can sleep on it; the mask before."""
    return set(signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCHLD}))  # type: ignore[arg-type]


def wait_until(look: Callable[[], T | None], limit_s: float, sleep_s: float = _SLICE_S) -> T | None:
    """Call ``look`` until it finds something; None after ``limit_s``.

    It may sleep for ``sleep_s`` where no other thread of ours can take the signal. Looking each millisecond
    takes three parts in a hundred of a processor, which tracees may share.

    Polls for :data:`SPIN_NS`, yielding to others meanwhile; then sleeps until a tracee reports. Who yields
    where others have work gets on after a time slice of theirs.
    """
    begin = time.monotonic_ns()
    while True:
        found = look()
        if found is not None:
            return found
        waited_ns = time.monotonic_ns() - begin
        if waited_ns >= limit_s * 1e9:
            return None
        if waited_ns > SPIN_NS:
            signal.sigtimedwait({signal.SIGCHLD}, sleep_s)
        else:
            os.sched_yield()  # tracees on our own processor need it to get anywhere
