"""A fault that recurs in the instructions of a node: the node is followed from its first struck call on."""

from __future__ import annotations

from collections.abc import Callable

from injector.recurrence.struck_calls import StrikeTally, StruckCalls
from injector.tracing.compiled_functions import compiled_functions
from injector.tracing.process import IdentityError, Process, ProcessIdentity
from injector.tracing.tracees import TraceeGroup
from services.bus.announce import Announcement
from services.models.faults.specification import FaultSpec
from services.models.outcome import InjectionRecord


def strike_calls(
    target: Announcement,
    marks: int,
    go: Callable[[], object],
    fault: FaultSpec,
    seed: int,
    tell: Callable[[InjectionRecord], None],
    tally: StrikeTally,
) -> None:
    """Strike the calls of a node that is at the gate until it is gone; ``go`` opens the gate.

    :raises IdentityError: if it is not what it was announced as, or gone.
    """
    with Process(ProcessIdentity.announced(target)) as process, TraceeGroup(ours=True) as tracees:
        tracees.seize([process.pid])
        process.verify()
        thread = tracees.threads.get(target.tid)
        if thread is None:
            message = f"process {process.pid} has no thread {target.tid}"
            raise IdentityError(message)
        calls = StruckCalls(
            tracees,
            thread,
            process,
            fault,
            target.name,
            seed,
            marks,
            tell,
            tally,
            compiled_functions(),
        )
        go()
        calls.follow()
