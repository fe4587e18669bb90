"""A rehearsal of the act on a process of our own, so that nothing is done for the first time while all stand.

Code that has run has its pages in memory and its modules loaded; a first time takes three times as long.
"""

from __future__ import annotations

import os
import signal

from injector.freeze import Tracees
from injector.process import Identity, Process
from injector.site import look
from injector.strike import strike
from services.bus import rng
from services.bus.lifeline import die_with_parent
from services.bus.mission import FaultSpec

TIMES = 5


def rehearse(fault: FaultSpec) -> None:
    """Do all but the flip to a fork of ourselves, which ends then. Only while we have no other thread."""
    nothing = FaultSpec(target=fault.target, model="none")
    own = os.getpid()
    pid = os.fork()
    if not pid:
        die_with_parent(own)
        while os.getppid() == own:
            pass
        os._exit(1)
    try:
        with Process(Identity.of(pid)) as process:
            for time in range(TIMES):
                with Tracees() as tracees:  # letting go is part of it
                    tracees.seize([pid])
                    tracees.stop_all()
                    thread = tracees.threads[pid]
                    thread.timed = True
                    look(thread, process)
                    draw = rng.generator(0, "rehearsal", time)
                    stop, go = tracees.stop_all, tracees.detach_all
                    strike(tracees, thread, process, nothing, draw, stop=stop, go=go)
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
