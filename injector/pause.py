"""The time in which everybody stands, and that nobody else holds us up in it.

Another process that takes our processor, or a node that we have just let go, would keep the rest standing for
the 4 ms of a time slice. Where the kernel grants it (CAP_SYS_NICE, or a limit RLIMIT_RTPRIO), our priority is
real-time from just before the first stop until after the last resume (sched(7)). A wait in it is for one
thread alone, and a :class:`injector.heartbeat.Heartbeat` ends it.
"""

from __future__ import annotations

import os
import time

from injector.heartbeat import Heartbeat

_LOWEST = 1


class Pause:
    """One pause after another; ``length_us`` is that of the last one."""

    def __init__(self) -> None:
        self.length_us = 0.0
        self._begin_ns = 0
        self._usual: tuple[int, os.sched_param] | None = None
        self._heartbeat: Heartbeat | None = None

    @property
    def under_way(self) -> bool:
        """Whether everybody stands, or is about to."""
        return self._begin_ns > 0

    @property
    def so_far_ns(self) -> int:
        """Its length up to now."""
        return time.monotonic_ns() - self._begin_ns

    def begin(self) -> None:
        """The first is about to be stopped; nothing happens if a pause is under way.

        :raises OSError: if the kernel gives us no timer.
        """
        if self.under_way:
            return
        self._heartbeat = Heartbeat()
        usual = os.sched_getscheduler(0), os.sched_getparam(0)
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_LOWEST))
        except PermissionError:
            pass
        else:
            self._usual = usual
        self._begin_ns = time.monotonic_ns()

    def end(self) -> None:
        """The last one has been let go; nothing happens if no pause is under way."""
        if not self.under_way:
            return
        self.length_us = self.so_far_ns / 1e3
        self._begin_ns = 0
        if self._heartbeat is not None:
            self._heartbeat.stop()
        if self._usual is not None:
            os.sched_setscheduler(0, *self._usual)
            self._usual = None
