"""Copies of a node that run a call ahead of it, from its beginning.

A probe (:mod:`services.runtime.probe_gate`) costs wall time only.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from injector.tracing.perf_events import ThreadTimer, await_trap
from injector.tracing.process import END_LIMIT_MS, AddressError, Process, ProcessIdentity, VanishedError
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from injector.tracing.waiting import wait_until
from services.bus.announce import Announcement
from services.runtime.kernel_timer import GATE_SIGNAL

LIMIT_S = 20.0
"""Wall time after which a probe is given up."""


@dataclass(frozen=True, slots=True)
class ProbeRun:
    """A copy of the target that stands at the beginning of the call."""

    tracees: TraceeGroup
    thread: Tracee
    process: Process

    def run(self) -> int:
        """Run to the end of the call; the thread time that it took, ns."""
        with ThreadTimer(self.thread, 10**15) as timer:
            self.tracees.resume(self.thread)
            await_trap(self.tracees, self.thread, lambda: False, LIMIT_S)
            return timer.spent_ns


@contextmanager
def sent_ahead(target: Announcement, send: Callable[[], None]) -> Iterator[ProbeRun]:
    """A probe that ``target`` forks once it is told to, at the beginning of its call; gone afterwards.

    :raises IdentityError: if the target is not what it was announced as, or gone.
    :raises ProbeError: if none comes.
    :raises VanishedError: if it is killed while its memory is read or written.
    """
    with Process(ProcessIdentity.announced(target)) as node, TraceeGroup(GATE_SIGNAL, forks=True) as tracees:
        tracees.seize([node.pid])
        node.verify()
        send()

        def forked() -> Tracee | None:
            tracees.service()
            new = [one for one in tracees.threads.values() if one.pid != node.pid]
            return new[0] if new and new[0].report is not None and new[0].report.kind == "gate" else None

        thread = wait_until(forked, LIMIT_S)
        if thread is None:
            message = f"process {node.pid} sent no probe within {LIMIT_S:g} s"
            raise ProbeError(message)
        with Process(ProcessIdentity.of(thread.pid)) as process, _on_one_processor(thread.pid):
            try:
                yield ProbeRun(tracees, thread, process)
            except AddressError as error:
                if not process.ends_within(END_LIMIT_MS):
                    raise
                message = f"process {process.pid} is gone"
                raise VanishedError(message) from error  # its memory goes first
            finally:
                with suppress(ProcessLookupError):
                    os.kill(thread.pid, signal.SIGKILL)


@contextmanager
def _on_one_processor(pid: int) -> Iterator[None]:
    """Hold ourselves and a process on the processor that we are on: stepping is three times as fast."""
    allowed = os.sched_getaffinity(0)
    one = {min(allowed)}
    try:
        with suppress(ProcessLookupError):  # killed; whoever wants something of it is told
            os.sched_setaffinity(pid, one)
        os.sched_setaffinity(0, one)
        yield
    finally:
        os.sched_setaffinity(0, allowed)


class ProbeError(Exception):
    """The target sends no probe, or a probe was killed."""


class ProbeLostError(ProbeError):
    """Somebody has killed a probe; its node lives and can send another one."""
