"""Injections without a flip into a fork of our own, so that all code has run once before the real one.

Code that has run has its pages in memory and its modules loaded; the first injection takes three times as
long.
"""

from __future__ import annotations

import os
import signal
from contextlib import suppress

from injector.faults.apply import apply_fault
from injector.faults.stopped_thread import TargetError
from injector.flight.fingerprint import fingerprint_of
from injector.tracing.process import Process, ProcessIdentity, VanishedError
from injector.tracing.tracees import TraceeGroup
from services.models.faults.specification import FaultSpec
from services.runtime import rng
from services.system.lifeline import die_with_parent

TIMES = 5


def warm_up_on_a_fork(fault: FaultSpec) -> None:
    """Do all but the flip to a fork of this process, and end it. Only while there is no other thread."""
    nothing = FaultSpec(target=fault.target, model="none", scope="thread")  # the fork runs no kernel
    own = os.getpid()
    pid = os.fork()
    if not pid:
        die_with_parent(own)
        while os.getppid() == own:
            pass
        os._exit(1)
    try:
        with suppress(VanishedError, TargetError), Process(ProcessIdentity.of(pid)) as process:
            for time in range(TIMES):
                with TraceeGroup() as tracees:  # letting go is part of it
                    tracees.seize([pid])
                    tracees.stop_all()
                    thread = tracees.threads.get(pid)
                    if thread is None:  # somebody else has killed it
                        return
                    thread.timed = True
                    fingerprint_of(thread, process, process.maps())
                    draw = rng.generator(0, "rehearsal", time)
                    stop, go = tracees.stop_all, tracees.detach_all
                    apply_fault(tracees, thread, process, nothing, draw, stop=stop, go=go)
    finally:
        with suppress(ProcessLookupError, ChildProcessError):  # killed, and we have heard of it as its tracer
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
