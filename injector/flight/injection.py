"""One injection from beginning to end: everybody is stopped, one is corrupted, all go on untraced."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict

import numpy as np

from injector.faults.record import record_of
from injector.faults.stopped_thread import InjectionResult
from injector.flight.approach import KernelCall, NodeApproach
from injector.tracing.elf import place
from injector.tracing.process import IdentityError, Process, ProcessIdentity, VanishedError
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.bus.announce import Announcement
from services.models.faults.specification import FaultSpec
from services.models.outcome import InjectionRecord
from services.runtime.kernel_timer import GATE_SIGNAL

POINTER_BITS = 64


def inject(
    call: KernelCall,
    others: Sequence[Announcement],
    fault: FaultSpec,
    draw: np.random.Generator,
    limit_s: float = 60.0,
) -> InjectionRecord:
    """Inject ``fault`` at its trigger's site, or after ``cpu_ns`` of the target's thread time.

    All threads of the target and of ``others`` (the injector's own process is none of them) stand while
    the bit is flipped; processes of ``others`` that are gone meanwhile are left out. When this returns or
    raises, nobody is traced. ``draw`` decides on jitter, register and bit. ``limit_s`` is wall time.

    :raises IdentityError: if a process is not what it was announced as, or the target is gone.
    :raises NotPermittedError, TriggerError: if the kernel forbids tracing or timing.
    :raises StopError: if a thread cannot be stopped.
    :raises TimeoutError: if the target comes neither to the place nor to the call's end within the limit.
    :raises ValueError: if the fault has no trigger that says where.
    """
    trigger = fault.trigger
    if trigger is None or (trigger.site is None and trigger.cpu_ns is None):
        raise ValueError(
            "a fault whose trigger names no place in the call cannot be injected: draw one first"
        )
    with ExitStack() as held:
        bystanders = []
        for one in others:
            with suppress(VanishedError):
                bystanders.append(held.enter_context(Process(ProcessIdentity.announced(one))))
        target = held.enter_context(Process(ProcessIdentity.announced(call.target)))
        with TraceeGroup(GATE_SIGNAL) as tracees:
            tracees.leave_out = call.leave_out
            thread = _seize(tracees, target, bystanders, call.target.tid)
            approach = NodeApproach(tracees, thread, target, call, fault, draw, limit_s)
            found = approach.run()
        return _record(approach, found)


def _seize(tracees: TraceeGroup, target: Process, bystanders: Sequence[Process], tid: int) -> Tracee:
    """Seize everybody, the target last; its thread ``tid``. Only now that they are held are checks final."""
    tracees.seize([process.pid for process in [*bystanders, target]])
    for process in bystanders:
        with suppress(VanishedError):
            process.verify()
    target.verify()
    thread = tracees.threads.get(tid)
    if thread is None or thread.pid != target.pid:
        message = f"process {target.pid} has no thread {tid}"
        raise IdentityError(message)
    return thread


def _record(approach: NodeApproach, found: InjectionResult) -> InjectionRecord:
    call, fault, tracees, maps = approach.call, approach.fault, approach.tracees, approach.maps
    trigger = fault.trigger
    assert trigger is not None  # noqa: S101 - checked where the injection began
    if trigger.site is not None and approach.fingerprint is not None and found.status != "diverged":
        seen = trigger.site.model_copy(update=asdict(approach.fingerprint))
        trigger = trigger.model_copy(update={"site": seen})
    return record_of(
        found,
        fault,
        node=call.target.name,
        kernel=fault.target,
        invocation=trigger.invocation or 0,
        location=lambda address: place(call.target.pid, maps, address, call.compiled),
        precision=trigger.site.precision if trigger.site is not None else "cpu_time",
        trigger=trigger,
        points_into=_target(approach, found),
        pid=call.target.pid,
        tid=call.target.tid,
        virtual_time_ns=call.virtual_time_ns,
        pause_us=tracees.pause_us,
        threads_stopped=tracees.threads_stopped,
    )


def _target(approach: NodeApproach, found: InjectionResult) -> str:
    """What the value that was struck points into, if it is a pointer."""
    if approach.pointers is None or found.width_bits != POINTER_BITS:
        return ""
    return approach.pointers.target(found.before)
