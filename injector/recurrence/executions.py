"""How many executions of a call a fault can strike: counted in a copy of the node that runs it ahead."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress

from injector.block_profile.injected_call import bury_child, injected_fork, restore_copy
from injector.recurrence.struck_code import FAR, StruckCode
from injector.tracing import ptrace
from injector.tracing.process import Process, ProcessIdentity
from injector.tracing.ptrace import GoneError
from injector.tracing.tracees import FAULTS
from services.runtime.kernel_timer import GATE_SIGNAL

COPY_LIMIT_S = 20.0
"""Wall time after which a copy is given up."""

DEADLY = frozenset({*FAULTS, signal.SIGABRT, signal.SIGSYS})
"""Signals of which a node dies by its own doing."""


def executions_ahead(tid: int, process: Process, code: StruckCode) -> int:
    """The number in the call at whose beginning the thread stands.

    A copy that dies by its own doing has as many as it came to.

    :raises TimeoutError: if it does not come to an end, or somebody kills it: our failure, no result.
    """
    copy_tid = injected_fork(tid, process)
    watchdog = threading.Timer(COPY_LIMIT_S, os.kill, (copy_tid, signal.SIGKILL))
    watchdog.start()
    try:
        with Process(ProcessIdentity.of(copy_tid)) as copy:
            restore_copy(copy, copy_tid, process)
            return _run(copy_tid, copy, code)
    except GoneError as error:
        message = f"a copy that ran a call ahead was killed, by us if it took {COPY_LIMIT_S:g} s"
        raise TimeoutError(message) from error
    finally:
        watchdog.cancel()
        watchdog.join()
        with suppress(ProcessLookupError):
            os.kill(copy_tid, signal.SIGKILL)
        with suppress(ChildProcessError):
            while ptrace.await_report(copy_tid).kind != "gone":
                pass
        bury_child(tid, process)


def _run(tid: int, copy: Process, code: StruckCode) -> int:
    """Run a copy to the end of its call, or to its death.

    :raises GoneError: if somebody kills it.
    """
    number = 0
    while True:
        ptrace.resume(tid, number)
        report, number = ptrace.await_report(tid), 0
        if report.kind == "gone":
            message = f"copy {tid} was killed"
            raise GoneError(message)
        if report.kind != "signal":
            continue
        ours = report.signal == signal.SIGTRAP and code.lead_on(tid, copy)
        if report.signal == GATE_SIGNAL or (report.signal in DEADLY and not ours):
            return FAR - code.get(code.words.left, copy)
        number = 0 if ours else report.signal
